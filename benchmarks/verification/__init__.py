"""Cases with a closed form or a published experiment, one a function: measures return numbers, cases return rows."""
