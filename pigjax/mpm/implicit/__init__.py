"""Implicit steps: Newton's method on the grid, Krylov solves, stiffness."""
