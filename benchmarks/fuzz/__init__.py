"""Damaged files for every reader: the valid files, the damage, and the processes that read."""
