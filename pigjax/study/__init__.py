"""Studies of a scene: an experiment with named parameters, and study files that sweep or tune them."""

from pigjax.study.experiment import Experiment, Outcome, experiment
from pigjax.study.objectives import OBJECTIVES
from pigjax.study.run import sweep_study, tune_study
from pigjax.study.schema import Study, load_study
from pigjax.study.voting import Voting, voting

__all__ = [
    "OBJECTIVES",
    "Experiment",
    "Outcome",
    "Study",
    "Voting",
    "experiment",
    "load_study",
    "sweep_study",
    "tune_study",
    "voting",
]
