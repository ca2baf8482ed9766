"""`pigjax view`: an interactive page. Logic in `session` and what it imports; `page` alone knows the browser."""
