"""Rivals' methods to find objects in a splat scene, re-made from their papers on pigjax's renderer for comparison."""
