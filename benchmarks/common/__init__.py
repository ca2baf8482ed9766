"""Shared by all benchmarks: the command line, the timer and the pages."""
