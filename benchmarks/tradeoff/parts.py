"""Speed against accuracy over every knob, stage by stage.

Each knob is turned alone from the standard, on the bundled tabletop, a jelly cube and a cube of sand (`--scenes`).
"""

from benchmarks.tradeoff import drawing, kernels, matter, reconstruction, voting, whole
from benchmarks.tradeoff.scenes import SCENES

PARTS = {
    "matter": ("Matter", matter.study),
    "kernels": ("Kernels", kernels.study),
    "drawing": ("Drawing", drawing.study),
    "voting": ("Voting", voting.study),
    "reconstruction": ("Reconstruction", reconstruction.study),
    "whole": ("The whole pipeline", whole.study),
}
OPTIONS = {"scenes": {"nargs": "*", "default": list(SCENES), "choices": SCENES, "help": "that are simulated"}}
DEVICES = None
