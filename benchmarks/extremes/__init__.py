"""Extremes: leaf functions over the whole float range, and drawing, votes, clamp, filling and matter at their edges."""
