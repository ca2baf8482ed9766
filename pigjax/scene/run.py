"""Running a scene: segment, simulate, draw. States are saved frame by frame, so that a killed run goes on."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path

import numpy as np

from pigjax import io
from pigjax.core.arguments import checked
from pigjax.core.errors import InputError, SimulationError, StaleError
from pigjax.mpm import Particles
from pigjax.mpm.active_grid import ActiveGrid
from pigjax.mpm.simulate import SimulatedFrame
from pigjax.mpm.sleep import Sleeper
from pigjax.scene.advice import plan_line
from pigjax.scene.arrangement import arrange
from pigjax.scene.budget import ScenePlan
from pigjax.scene.health import MARK, Record, drift, health_record, remarks, summary
from pigjax.scene.own import MADE, chosen, is_torn, laws_of, surfaces_of, waits_for_motion, with_own
from pigjax.scene.pace import Pace, Progress, Say
from pigjax.scene.pictures import SHEET_FRAMES, Pictures, draw_run
from pigjax.scene.plan import Inputs, Plan, make_plan, provenance, read_inputs, segment
from pigjax.scene.replay import COLLIDER_FILE, REST_FILE, SCENE_FILE, rows_of, store_colliders, store_rest
from pigjax.scene.report import RunReport
from pigjax.scene.report_page import report_page
from pigjax.scene.required import counted
from pigjax.scene.run_error import Followed, estimated_error
from pigjax.scene.schema import Scene, values_of
from pigjax.scene.stages import Stage, simulate_stages, stages_of
from pigjax.scene.world import described
from pigjax.segmentation import Labels

_FILES = (
    "video.mp4", "contact_sheet.png", "objects.png", "labels.npz", COLLIDER_FILE, REST_FILE, SCENE_FILE, "report.json",
    "report.html",
)  # fmt: skip


@checked
def run_scene(
    scene: Scene,
    out_dir: str | os.PathLike[str],
    *,
    progress: Progress | None = None,
    say: Say | None = None,
    overwrite: bool = False,
    planned: ScenePlan | None = None,
) -> RunReport:
    """Simulate a scene and draw its video. Host.

    Into `out_dir` go `video.mp4`, `contact_sheet.png`, `objects.png` (the objects in their colours), `labels.npz`,
    `colliders.npz` (of still objects), `states/<frame>.npz` (x, v and F_visual of every particle),
    `states/particles.npz` (Gaussian, object, material, mass and rest volume of each), `scene.toml` (every setting, to
    reproduce), `report.json` and the page `report.html`; `load_run` reads them. A run that was killed goes on from its
    last state; when all states are there, only the video is redrawn.

    Args:
        scene: as `load_scene` gives it.
        out_dir: folder for the results, made if it is missing.
        progress: told each stage, frames done and frames to do.
        say: told the plan (particles, grid, substeps, time expected) and remarks on the scene before it is simulated,
            a line each; they are in the report, too.
        overwrite: replace states in `out_dir` that were made from something else, instead of refusing them.
        planned: of `plan_scene`; `scene` is usually its `scene`. The run then tells the time of this machine, and
            compares it with the time spent, at the end of each stage and at each quarter of the frames, and warns where
            the budget will be broken.

    Raises:
        StaleError: the states in `out_dir` were made from other settings or files; it names what changed.
        InputError: a file is missing or damaged, or the scene asks for something that cannot be.
        SimulationError: the simulation broke down; states up to the last good frame are kept.
    """
    out = io.output_folder(out_dir, files=_FILES, folders=("states",))
    report = RunReport()
    tell = Pace(progress, say, planned)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            _run(scene, out, report, tell, say or (lambda line: None), overwrite)
        except StaleError:
            raise  # report.json still tells of the results that are there
        except BaseException as error:
            _leave_report(scene, report, caught, out, error=str(error) or type(error).__name__)
            raise
        _leave_report(scene, report, caught, out)
    return report


def _leave_report(
    scene: Scene, report: RunReport, caught: list[warnings.WarningMessage], out: Path, *, error: str | None = None
) -> None:
    report.warnings += list(dict.fromkeys(str(w.message) for w in caught))
    io.write_json(out / "report.json", report.as_dict())
    settings = io.toml_text(values_of(scene, out))
    io.write_text(out / "report.html", report_page(scene, report, settings=settings, sheet=report.sheet, error=error))


def _run(
    scene: Scene,
    out: Path,
    report: RunReport,
    tell: Pace,
    say: Say,
    overwrite: bool,
) -> None:
    with report.stage("read"):
        inputs = read_inputs(scene)
        parts = provenance(scene, inputs)
        results = (io.STATES, "last.ckpt")
        key = io.claim(out / "states", parts, results=results, overwrite=overwrite, signed=io.signed)
    with report.stage("segment"):
        tell("segment", 0, 1)
        given = scene
        scene, inputs, labels = arrange(scene, inputs, segment(scene, inputs))
        tell("segment", 1, 1)
    with report.stage("seed"):
        tell("seed", 0, 1)
        voted, plan = labels, make_plan(scene, inputs, labels)
        labels = plan.labels
        rows = rows_of(plan.particles, labels)
        made = _made_before(out / REST_FILE)
        _store(scene, inputs, plan, rows, out, key, made)
        store_colliders(out / COLLIDER_FILE, scene, plan.colliders)
        io.write_toml(out / SCENE_FILE, values_of(given, out))
        tell("seed", 1, 1)
    _describe(scene, inputs, plan, labels, report)
    for remark in plan.remarks:
        say(f"note: {remark}")
    report.warnings += plan.remarks
    stages = stages_of(plan, scene.simulation.frames)
    _predict(scene, inputs, plan, stages, report, tell)
    say(report.plan)
    seen, shown, surfaces, laws = inputs, plan, None, laws_of(scene, plan)
    own_wanted = any(entry.splats != "carried" for entry in scene.objects.values())

    def make_own() -> None:
        nonlocal seen, shown, surfaces
        with report.stage("splats"):
            tell("splats", 0, 1)
            names = chosen(scene, laws, partial(_was_torn, scene, inputs, rows, out / "states", key))
            seen, shown, own = with_own(scene, inputs, plan, names, stored=made, say=say)
            if names:
                rows["gaussian"] = np.asarray(shown.particles.gaussian)
                _store(scene, seen, shown, rows, out, key, own)
                surfaces = surfaces_of(own, rows["object"], plan.particles.x, plan.dx)
                report.sizes["own_splats_of"] = {
                    name: int(np.sum(np.asarray(shown.labels.object_id) == inputs.ids[name])) for name in names
                }
            tell("splats", 1, 1)

    pictures = None  # compiled beside the simulation, where what they show is known before it
    if not (later := own_wanted and waits_for_motion(scene, laws)):
        if own_wanted:
            make_own()
        pictures = Pictures.of(scene, seen, shown)
    states = _simulate(scene, plan, stages, out / "states", parts, key, report, tell)
    followed = None
    if frames := min(scene.output.error_frames, scene.simulation.frames):
        followed = Followed(np.asarray(plan.particles.gaussian), frames, out / "states", key)
        states = followed.along(states)
    if scene.output.states_every == 1:
        with report.stage("simulate"):
            for _ in states:
                pass
    if later:
        make_own()
    report.modelled["reused"] = inputs.reused
    with report.stage("draw"):
        pictures = pictures or Pictures.of(scene, seen, shown)
        draw_run(scene, seen, shown, shown.labels, pictures, out, key, report, tell, states, surfaces)
        report.files |= {name.split(".")[0]: str(out / name) for name in (*_FILES, "states")}
    if followed is not None:
        with report.stage("estimate"):
            tell("estimate", 0, 1)
            report.estimated_error |= estimated_error(scene, inputs, voted, plan, followed) or {}
            tell("estimate", 1, 1)
        if not report.estimated_error:
            report.warnings.append(
                "output.error_frames: nothing moved, or no state was there, so that no error is estimated."
            )
    tell.end(report)


def _predict(scene: Scene, inputs: Inputs, plan: Plan, stages: list[Stage], report: RunReport, pace: Pace) -> None:
    """What the run requires and will cost, told by the report."""
    first = stages[0].rule
    needs = counted(scene, inputs, plan, substeps=first.first, integrator=first.config.integrator)
    prediction = pace.counted(needs)
    report.plan = plan_line(needs, prediction)
    report.predicted |= prediction.as_dict() | {"required": {**asdict(needs), "bodies": list(map(list, needs.bodies))}}


def _store(
    scene: Scene, inputs: Inputs, plan: Plan, rows: dict[str, np.ndarray], out: Path, key: str,
    own: dict[str, np.ndarray],
) -> None:  # fmt: skip
    """Write what poses the splats of every frame: labels, rows of the particles, and the rest state."""
    labels = plan.labels
    io.save_labels(
        out / "labels.npz", labels.object_id, labels.votes, labels.confidence, labels.ids, scene=_mark(scene, inputs)
    )
    io.save_rows(out / "states", rows, signature=key)
    store_rest(out / REST_FILE, inputs, plan.dx, own)


def _made_before(path: Path) -> dict[str, np.ndarray]:
    """Splats that an earlier run made for its matter; they are used again where they fit."""
    if not path.is_file():
        return {}
    try:
        return io.load_arrays(path, "file of a run's rest state", remedy="run the scene again", prefixes=(MADE,))
    except InputError:  # cut short by a kill: they are made again
        return {}


def _was_torn(scene: Scene, inputs: Inputs, rows: dict[str, np.ndarray], folder: Path, key: str, name: str) -> bool:
    """Whether an object was torn in a frame; some of them are looked at, the last among them."""
    if scene.output.states_every != 1:
        warnings.warn(
            f'objects.{name}.splats = "auto": its stretch is measured where all states are kept; drawn by the splats of'
            ' the capture. Set output.states_every = 1, or splats = "own".',
            stacklevel=2,
        )
        return False
    own = rows["object"] == inputs.ids[name]
    frames = np.unique(np.linspace(0, scene.simulation.frames, SHEET_FRAMES).round().astype(int)).tolist()
    return any(is_torn(io.load_state(folder, frame, signature=key)["F_visual"][own]) for frame in reversed(frames))


def _mark(scene: Scene, inputs: Inputs) -> str | None:
    """Digest of the Gaussians that labels belong to; None where they are not as in the file."""
    moved = scene.input.origin is not None or inputs.moved
    return None if moved else io.digest_of_scene(inputs.gaussians)


def _describe(scene: Scene, inputs: Inputs, plan: Plan, labels: Labels, report: RunReport) -> None:
    names = {number: name for name, number in inputs.ids.items()}
    object_id = np.asarray(labels.object_id)
    moving = [name for name, entry in scene.objects.items() if not entry.fixed]
    of_object, of_law = _particles_of(moving, plan.particles.counts, plan.table.laws)
    report.modelled |= {
        "accuracy": scene.accuracy,
        "laws": sorted(set(plan.table.laws)),
        "colliders": [type(c).__name__ for c in plan.colliders],
        "kernel": plan.config.kernel,
        "clamp": scene.clamp.mode,
        "forces": [type(force).__name__ for force in plan.forces],
        "body_contact": plan.contact is not None,
        "sleep": plan.sleep is not None,
        "pins": len(plan.pins),
        "sh_coefficients": inputs.gaussians.sh.shape[1],
    }
    if inputs.world is not None:
        report.modelled["world"] = described(inputs.world)
    report.sizes |= {
        "gaussians": len(inputs.gaussians),
        "gaussians_of": {names.get(k, f"id {k}"): int(np.sum(object_id == k)) for k in np.unique(object_id)},
        "particles": len(plan.particles),
        "particles_of": of_object,
        "particles_of_law": of_law,
        "gaussians_without_particle": 0 if plan.binding is None else len(plan.binding),
        "frames": scene.simulation.frames,
        "dx": plan.dx,
        "mass_kg": float(plan.particles.mass.sum()),
    }
    if inputs.filled:
        report.sizes["filled"] = inputs.filled


def _particles_of(
    objects: Sequence[str], counts: Sequence[int], laws: Sequence[str]
) -> tuple[dict[str, int], dict[str, int]]:
    """Particles of each object, and of each law, which several objects may share; rows of the table in their order."""
    of_law = dict.fromkeys(laws, 0)
    for count, law in zip(counts, laws):
        of_law[law] += count
    return dict(zip(objects, counts)), of_law


def _simulate(
    scene: Scene,
    plan: Plan,
    stages: list[Stage],
    folder: Path,
    parts: dict[str, str],
    key: str,
    report: RunReport,
    tell: Progress,
) -> Iterator[int]:
    """Simulate the frames that are not on disk yet, from the last checkpoint on; yields the last one that is there.

    States that are missing before it are simulated again from the start, with the same bits.
    """
    frames, particles = scene.simulation.frames, plan.particles
    present = io.readable_states(folder, signature=key)
    checkpoint = folder / "last.ckpt"
    active = ActiveGrid() if plan.sleep is None else Sleeper(settings=plan.sleep, body=np.asarray(particles.body))
    run = partial(simulate_stages, plan, stages, active_grid=active)
    config = stages[-1].rule.config
    saved = io.resumed(checkpoint, (np.zeros((), np.int64), particles, active.memory()), parts=parts)
    last = 0 if saved is None else int(saved[0])
    missing = set(range(last + 1)) - present  # of a run without a checkpoint all frames from the first are made again
    repaired = 0 if saved is None else max(missing, default=0)
    # of all frames, as their states may not stay on disk
    records = {0: health_record(particles, None, plan.gravity, plan.table)} | _records(folder, present, key)
    half = scene.output.compress_states
    if saved is None or 0 in missing:
        _save(folder, 0, particles, records[0], key, half=half)
    if saved is None:
        _checkpoint(checkpoint, 0, particles, active, parts)
    if repaired:
        warnings.warn(f"{folder}: states of {len(missing)} frames are missing or damaged; made again.", stacklevel=2)
    report.modelled["integrator"] = config.integrator

    def todo() -> Iterator[SimulatedFrame]:
        """Frames that are missing, from the start, then those after the checkpoint."""
        yield from run(particles, frames=range(repaired))
        if saved is None:
            yield from run(particles, frames=range(frames))
        else:
            _, resumed, memory = saved
            active.remember(memory)
            yield from run(resumed, frames=range(last, frames))

    tell("simulate", 0 if repaired else last, frames)
    yield 0 if repaired else last
    for frame, after, _, health in todo():
        records[frame] = record = health_record(after, health, plan.gravity, plan.table)
        if health.is_broken():
            report.health |= summary({number: known for number, known in records.items() if number <= frame})
            raise SimulationError(
                f"frame {frame} of {frames}: {', '.join(health.problems())}; states up to frame {frame - 1} are kept in"
                f" {folder}. Lower simulation.cfl, or make matter softer or slower."
            )
        if frame > last or frame in missing:
            _save(folder, frame, after, record, key, half=half)
        if frame > last:
            _checkpoint(checkpoint, frame, after, active, parts)
        if frame < frames:
            tell("simulate", frame, frames)
        yield frame
    tell("simulate", frames, frames)
    most = max((int(record["substeps"]) for frame, record in records.items() if frame), default=stages[0].rule.first)
    report.sizes |= {"substeps_per_frame": most, "last_grid": active.shape, "resumed_from_frame": last}
    report.health |= summary(records) | {"drift": drift(records, plan)}
    driven = bool(plan.forces) or any(collider.moves for collider in plan.colliders)
    report.warnings += remarks(report.health, driven=driven)
    if isinstance(active, Sleeper):
        report.sizes["asleep_at_the_end"] = int(active.asleep.sum())


def _records(folder: Path, frames: Iterable[int], key: str) -> dict[int, Record]:
    """Health of each of the frames, from the states on disk."""
    records: dict[int, Record] = {}
    for frame in frames:
        state = io.load_state(folder, frame, signature=key, prefix=MARK)
        if state:
            records[frame] = {name.removeprefix(MARK): values for name, values in state.items()}
    return records


def _save(folder: Path, frame: int, particles: Particles, record: Record, key: str, *, half: bool) -> None:
    arrays = {name: np.asarray(getattr(particles, name)) for name in ("x", "v", "F_visual")}
    if half:
        arrays |= {name: arrays[name].astype(np.float16) for name in ("v", "F_visual")}
    arrays |= {MARK + name: np.asarray(values) for name, values in record.items()}
    io.save_state(folder, frame, arrays, signature=key, compress=half)


def _checkpoint(path: Path, frame: int, particles: Particles, active: ActiveGrid, parts: dict[str, str]) -> None:
    io.save_pytree(path, (np.asarray(frame), particles, active.memory()), parts=parts)
