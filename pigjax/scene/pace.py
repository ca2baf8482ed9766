"""The time of a run beside its prediction and its budget, stage by stage while it goes on."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable

from pigjax.scene.budget import ScenePlan, asked, refined, told
from pigjax.scene.costs import ESTIMATE, Prediction, Priced, Required, duration, predict
from pigjax.scene.report import RunReport

Progress = Callable[[str, int, int], None]  # stage, done, of
Say = Callable[[str], None]  # a line to read


class Pace:
    """The progress of a run, told on; of a run that was planned, lines on its time and a warning beyond its budget.

    At the end of each stage and at each quarter of the frames a line has the time so far, the prediction of that, and
    the time of the whole run that follows: the time so far and the prediction of the rest. The first time that this is
    above the budget, a warning says so. A run that goes on from saved states does only a part, and tells nothing.
    """

    def __init__(
        self,
        progress: Progress | None,
        say: Say | None,
        planned: ScenePlan | None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        """The run begins now.

        Args:
            progress: told each stage, frames done and frames to do.
            say: told the lines.
            planned: of `plan_scene`; None: the run was not planned, and there are no lines.
            clock: gives the time [s].
        """
        self._progress, self._say, self._planned, self._clock = progress, say, planned, clock
        self._prediction = None if planned is None else planned.prediction
        self._begun = clock()
        self._shares: dict[str, float] = {"read": 1.0}  # of the work that is done, by stage
        self._resumed = self._late = False

    def __call__(self, stage: str, done: int, of: int) -> None:
        """Tell the progress of a stage."""
        if self._progress is not None:
            self._progress(stage, done, of)
        first, before = stage not in self._shares, self._shares.get(stage, 0.0)
        self._resumed |= stage == "simulate" and first and done > 0
        self._shares[stage] = share = done / max(of, 1)
        parts = 4 if of > 1 else 1
        if math.floor(parts * share) > math.floor(parts * before):
            self._tell(stage if of <= 1 or done == of else f"{stage} {done} of {of}")

    def counted(self, needs: Required) -> Prediction:
        """The prediction by numbers that are counted by now; a warning where it breaks the budget.

        Args:
            needs: of the seeded scene.
        """
        if self._planned is None:
            return predict(needs)
        self._prediction = found = refined(self._planned, needs)
        budget = self._planned.budget
        if budget.broken_by(found) > 1:
            self._warn(
                f"counted from its particles the run takes {told(found)}, more than the budget of {asked(budget)}; give"
                " a smaller one, or a coarser simulation.dx."
            )
        return found

    def end(self, report: RunReport) -> None:
        """Tell the time of the whole run beside its prediction, by the stages of its report.

        Args:
            report: of the run.
        """
        if self._prediction is None or self._resumed:
            return
        p, spent = self._prediction, report.times.values()
        took, compiling = math.fsum(t.run for t in spent), math.fsum(t.compile for t in spent)
        self._tell_line(
            f"predicted {duration(p.run_seconds)} and {duration(p.compile_seconds)} to compile; took"
            f" {duration(took)} and {duration(compiling)}"
        )

    def _tell(self, what: str) -> None:
        if self._prediction is None or self._planned is None or self._resumed:
            return
        spent = self._clock() - self._begun
        expected = math.fsum(self._done(part) for part in self._prediction.parts)
        whole = spent + max(self._prediction.seconds - expected, 0.0)
        self._tell_line(
            f"{what}: {duration(spent)} so far, {duration(expected)} predicted; about {duration(whole)} in all"
        )
        most = self._planned.budget.time
        if most is not None and whole > most and not self._late:
            self._late = True
            self._warn(
                f"the run takes about {duration(whole)} in all, more than the {duration(most)} that it may take."
            )

    def _done(self, part: Priced) -> float:
        """Seconds of a part that are spent by the prediction: all of its compilation once its stage has begun."""
        stage = part.name.partition(":")[0] if part.stage == "compile" else part.stage
        stage = "estimate" if ESTIMATE in part.name else stage
        if stage not in self._shares:
            return 0.0
        return part.seconds if part.stage == "compile" else part.seconds * self._shares[stage]

    def _warn(self, text: str) -> None:
        warnings.warn(text, stacklevel=3)
        self._tell_line(f"note: {text}")

    def _tell_line(self, line: str) -> None:
        if self._say is not None:
            self._say(line)
