"""Plans: what a run will cost, and the settings on the measured front that keep a budget of time, memory or error."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any

from msgspec import structs

from pigjax.core.arguments import checked
from pigjax.core.checks import shown
from pigjax.core.errors import InputError
from pigjax.scene.accuracy import LEVELS
from pigjax.scene.costs import Prediction, Prices, Required, duration, predict, shipped_prices
from pigjax.scene.probe import speed_against
from pigjax.scene.report import RunReport
from pigjax.scene.report_page import left_out
from pigjax.scene.required import drawn, required_by, survey
from pigjax.scene.schema import Scene

# knobs that are Pareto members of docs/results/TRADEOFF.md: factors on dx, a longer step, and drawings
_COARSENINGS = (3.0, 2.0, 1.5, 1.2, 1.0, 0.85, 0.75, 0.5)
_LONG_STEP = 0.8  # a fluid that is compressed by 3 % breaks down at it, other laws at 0.9 and more (STABILITY.md)
_DRAWINGS: tuple[dict[str, float], ...] = (
    {"scale": 0.5, "alpha_min": 1 / 64},
    {"scale": 0.75, "alpha_min": 1 / 64},
    {"scale": 1.0, "alpha_min": 1 / 64},
    {},  # those of the scene
    {"scale": 1.0, "alpha_min": 1e-4},
)
_UNITS = {"time": {"": 1.0, "s": 1.0, "min": 60.0, "h": 3600.0}, "memory": {"": 1.0, "MB": 1e6, "GB": 1e9, "TB": 1e12},
          "error": {"": 1.0, "%": 0.01}}  # fmt: skip
_EXAMPLES = {"time": '60 or "2 min"', "memory": '"4 GB"', "error": '"1 %"'}
_NUMBER = re.compile(r"\s*([0-9.eE+-]+)\s*([A-Za-z%]*)\s*")


@dataclass(frozen=True)
class Budget:
    """Bounds on a run; None: no bound."""

    time: float | int | None = None  # of the whole run, compilation included [s]
    error: float | int | None = None  # of the motion, as a share of its distance, and of the colours by drawing
    memory: float | int | None = None  # of the process [bytes]

    @property
    def is_open(self) -> bool:
        """Whether nothing is bounded."""
        return self == Budget()

    def broken_by(self, prediction: Prediction) -> float:
        """Largest ratio of a predicted number to its bound; at most 1 where the budget is kept."""
        worst = max(prediction.error, prediction.picture_error)
        pairs = ((prediction.seconds, self.time), (worst, self.error), (prediction.memory, self.memory))
        return max((value / bound for value, bound in pairs if bound is not None), default=0.0)


@dataclass(frozen=True)
class Choice:
    """Settings that could be run, and their prediction."""

    changes: dict[str, dict[str, Any]]  # fields that differ from the scene's, by section
    required: Required
    prediction: Prediction
    coarsening: float = 1.0  # factor of the scene's level of accuracy on the spacing that a file or `--set` gives

    @property
    def settings(self) -> list[str]:
        """The changes as `--set` takes them, at the scene's level of accuracy: "simulation.dx=0.018"."""
        return [
            f"{section}.{name}={value / (self.coarsening if name == 'dx' else 1):.9g}"  # 9 digits: dx of the run in 8
            for section, fields in self.changes.items()
            for name, value in fields.items()
        ]

    @property
    def cost(self) -> tuple[float, float]:
        """Numbers of which less is better: time, and error of motion and of colour as one root of squares."""
        return self.prediction.seconds, math.hypot(self.prediction.error, self.prediction.picture_error)


@dataclass(frozen=True)
class ScenePlan:
    """Requirements and cost of a run, and the settings that keep a budget; `plan_scene` makes it."""

    scene: Scene  # with the chosen settings
    chosen: Choice  # the settings that keep the budget
    given: Choice  # the scene's own settings
    front: tuple[Choice, ...]  # settings that no other beats in time and error, and the chosen ones, quickest first
    budget: Budget  # bounds that were asked for
    left_out: list[str]  # what is not modelled, with the setting that would
    speed: dict[str, float]  # time of the small tasks of the probe here over that on the prices' machine
    source: str  # machine on which the prices were measured

    @property
    def required(self) -> Required:
        """Requirements of the chosen settings."""
        return self.chosen.required

    @property
    def prediction(self) -> Prediction:
        """Time, memory and error of the chosen settings."""
        return self.chosen.prediction

    @property
    def settings(self) -> list[str]:
        """Fields that the budget changed, as `--set` takes them beside the scene's own level of accuracy."""
        return self.chosen.settings


@checked
def plan_scene(
    scene: Scene,
    *,
    time: float | int | str | None = None,
    error: float | int | str | None = None,
    memory: float | int | str | None = None,
    probe: bool = True,
) -> ScenePlan:
    """Predict time, memory and error of a scene's run, and choose settings that keep a budget. Host.

    The scene is read; its particles are estimated, not seeded, and masks are looked up in some photos, where the run
    lets all vote. With a bound on the error the quickest settings that keep the budget are chosen. Otherwise the
    scene's own stay where they keep it, and where they do not the most accurate ones that do are taken. Settings come
    from the front that `benchmarks/tradeoff` measured: `simulation.dx`, `drawing.scale`, `drawing.alpha_min` and,
    where nothing is a fluid, `simulation.cfl`.

        plan = pj.plan_scene(pj.load_scene("scene.toml"), time="1 min")
        pj.run_scene(plan.scene, "out", planned=plan)

    Args:
        scene: as `load_scene` gives it.
        time: most seconds of the run, compilation included, or a text with a unit ("2 min"). Compilation counts as of
            a first run. None: no bound.
        error: largest error, as a share or a text ("1 %"), of the distance that matter travels and of the colours.
            None: no bound.
        memory: most bytes of the process, or a text with a unit ("4 GB"). None: no bound.
        probe: whether this machine's speed is measured first, once in a process, which takes some seconds; without it
            times are those of the machine on which the prices were measured.

    Raises:
        InputError: a bound is no number; no settings of the front keep the budget (the message names the nearest);
            or the scene's files are missing or damaged.
    """
    budget = Budget(bound("time", time), bound("error", error), bound("memory", memory))
    prices = shipped_prices()
    looked = survey(scene)
    speed = speed_against(prices.probe) if probe else {}

    known: dict[tuple[Any, ...], Required] = {}  # of settings of the matter, which take longer than a product

    def choice(changes: dict[str, dict[str, Any]]) -> Choice:
        there, matter = changed(looked.scene, changes), tuple(changes.get("simulation", {}).items())
        if matter not in known:
            known[matter] = required_by(looked, there)
        needs = drawn(known[matter], there)
        return Choice(changes, needs, predict(needs, prices, speed=speed or None), LEVELS[scene.accuracy].coarsening)

    given = choice({})
    choices = [given]
    if not budget.is_open:
        choices += candidates(scene, given.required, choice)
    best = choose(budget, choices)
    report = RunReport(modelled={"sh_coefficients": looked.inputs.gaussians.sh.shape[1]})
    return ScenePlan(
        scene=changed(scene, best.changes),
        chosen=best,
        given=given,
        front=tuple(sorted([*(c for c in front_of(choices) if c is not best), best], key=lambda c: c.cost)),
        budget=budget,
        left_out=left_out(scene, report),
        speed=speed,
        source=prices.source,
    )


def changed(scene: Scene, changes: Mapping[str, Mapping[str, Any]]) -> Scene:
    """The scene with some fields of some sections replaced.

    Args:
        scene: as it is.
        changes: values by section and field.
    """
    sections = {name: structs.replace(getattr(scene, name), **fields) for name, fields in changes.items()}
    return structs.replace(scene, **sections)


def candidates(
    scene: Scene, given: Required, choice: Callable[[dict[str, dict[str, Any]]], Choice]
) -> Iterable[Choice]:
    """Settings of the measured front around a scene's own.

    Args:
        scene: its settings.
        given: what they require.
        choice: predicts changed settings.
    """
    longer = scene.simulation.cfl < _LONG_STEP and "fluid" not in given.particles_of_law
    steps = [scene.simulation.cfl] + [_LONG_STEP] * longer
    drawings = list({tuple(_drawing(scene, fields).items()): _drawing(scene, fields) for fields in _DRAWINGS}.values())
    for factor, cfl in product(_COARSENINGS, steps):
        matter: dict[str, Any] = {} if factor == 1 else {"dx": float(f"{given.dx * factor:.3g}")}
        matter |= {} if cfl == scene.simulation.cfl else {"cfl": cfl}
        for drawing in drawings:
            sections = {"simulation": matter, "drawing": drawing}
            changes = {name: fields for name, fields in sections.items() if fields}
            if changes:
                try:
                    yield choice(changes)
                except InputError:  # too coarse or too fine to be simulated
                    continue


def _drawing(scene: Scene, fields: Mapping[str, float]) -> dict[str, float]:
    """Fields of a drawing that differ from the scene's; sizes are shares of the scene's."""
    spec = scene.drawing
    values = {"scale": spec.scale * fields.get("scale", 1.0), "alpha_min": fields.get("alpha_min", spec.alpha_min)}
    return {name: value for name, value in values.items() if value != getattr(spec, name)}


def front_of(choices: Iterable[Choice]) -> list[Choice]:
    """Those that no other choice beats in time and error; quickest first.

    Args:
        choices: any.
    """
    choices = sorted(choices, key=lambda c: c.cost)
    return [c for c in choices if not any(_beats(other.cost, c.cost) for other in choices)]


def _beats(one: tuple[float, ...], other: tuple[float, ...]) -> bool:
    return all(a <= b for a, b in zip(one, other)) and one != other


def choose(budget: Budget, choices: list[Choice]) -> Choice:
    """The settings that keep a budget best; the first choice is the scene's own, which stay where they do.

    Args:
        budget: bounds.
        choices: the scene's own settings, then others.

    Raises:
        InputError: none keeps it; the message names the nearest that can be had.
    """
    own = choices[0]
    kept = [c for c in choices if budget.broken_by(c.prediction) <= 1]
    if not kept:
        raise InputError(_refusal(budget, choices))
    if own in kept and budget.error is None:
        return own
    if budget.error is not None:
        return min(kept, key=lambda c: c.cost)
    return min(kept, key=lambda c: c.cost[::-1])


def _refusal(budget: Budget, choices: list[Choice]) -> str:
    """The budget, and the nearest choices: for each bound, the best that the others leave, and the least broken."""
    nearest = min(choices, key=lambda c: budget.broken_by(c.prediction))
    settings = ", ".join(nearest.settings) or "the scene's own settings"
    found = [f"the nearest is {told(nearest.prediction)} with {settings}"]
    quickest = min(choices, key=lambda c: c.prediction.seconds)
    if budget.time is not None and quickest.prediction.seconds > budget.time:
        found.append(f"no setting takes less than {duration(quickest.prediction.seconds)}")
    finest = min(choices, key=lambda c: max(c.prediction.error, c.prediction.picture_error))
    worst = max(finest.prediction.error, finest.prediction.picture_error)
    if budget.error is not None and worst > budget.error:
        found.append(f"no setting has an error below {_percent(worst)}")
    smallest = min(choices, key=lambda c: c.prediction.memory)
    if budget.memory is not None and smallest.prediction.memory > budget.memory:
        found.append(f"no setting takes less than {smallest.prediction.memory / 1e9:.2g} GB")
    return (
        f"{asked(budget)} cannot be kept: {'; '.join(found)}. Ask for that, or take fewer frames or smaller pictures."
    )


def asked(budget: Budget) -> str:
    """The bounds of a budget in words.

    Args:
        budget: with one bound or more.
    """
    texts = (
        "" if budget.time is None else f"time = {budget.time:g} s",
        "" if budget.error is None else f"error = {_percent(budget.error)}",
        "" if budget.memory is None else f"memory = {budget.memory / 1e9:g} GB",
    )
    return ", ".join(text for text in texts if text)


def told(prediction: Prediction) -> str:
    """Time, error and memory of a prediction in words.

    Args:
        prediction: of a run.
    """
    worst = max(prediction.error, prediction.picture_error)
    return f"{duration(prediction.seconds)}, an error of {_percent(worst)} and {prediction.memory / 1e9:.2g} GB"


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %"


def bound(name: str, value: float | int | str | None) -> float | None:
    """A bound as a number: seconds, bytes or a share.

    Args:
        name: "time", "memory" or "error".
        value: a number, or a text with a unit: "2 min", "4 GB", "1 %".

    Raises:
        InputError: it is none, or not > 0.
    """
    if value is None:
        return None
    found = _NUMBER.fullmatch(value if isinstance(value, str) else repr(float(value)))
    units = _UNITS[name]
    try:
        number = float(found[1]) * units[found[2]] if found else math.nan
    except (ValueError, KeyError):
        number = math.nan
    if not 0 < number < math.inf:
        known = ", ".join(unit for unit in units if unit)
        raise InputError(f"{name} = {shown(value)}: give a number > 0, with or without a unit ({known}), as in"
                         f" {_EXAMPLES[name]}.")  # fmt: skip
    return number


def refined(plan: ScenePlan, needs: Required, prices: Prices | None = None) -> Prediction:
    """The prediction of a plan with numbers that are counted by now.

    Args:
        plan: made before.
        needs: of the seeded scene.
        prices: by default those of `costs.json`.
    """
    return predict(needs, prices, speed=plan.speed or None)
