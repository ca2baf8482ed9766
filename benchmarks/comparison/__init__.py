"""Whole methods beside each other: the same scene, velocities and scores for each."""
