"""Studies of a scene: an experiment with named parameters, and study files that sweep or tune them."""

from pigjax.study.experiment import Experiment, Outcome, experiment

__all__ = ["Experiment", "Outcome", "experiment"]
