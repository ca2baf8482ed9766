"""Arrays, errors, checks, 3x3 linear algebra, cameras and metrics: what every other package stands on."""
