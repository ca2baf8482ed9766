"""Bodies that sleep: what is simulated without them is what is simulated with them, and they wake before contact."""

import importlib.util

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rounding import assert_same
from scenes import ball, values

from pigjax import io
from pigjax.core.errors import InputError, SceneError
from pigjax.mls_mpm import SimConfig, rollout
from pigjax.mpm import Grid, make_particles, vast_grid
from pigjax.mpm.active_grid import ActiveGrid
from pigjax.mpm.colliders import Plane, Sphere
from pigjax.mpm.materials import Material, material_table
from pigjax.mpm.program import StepInputs
from pigjax.mpm.sleep import Sleep, Sleeper
from pigjax.scene import run_scene, scene_from

DX = 1 / 16
TABLE = material_table([Material("neo_hookean", density=500.0, young=2e4, poisson=0.3)])
SIDE = 4  # particles
NO_GRAVITY = (0.0, 0.0, 0.0)


def cubes(corners, velocities):
    """Cubes of two cells a side with their lower corners at numbers of cells."""
    cube = DX / 2 * (np.stack(np.meshgrid(*[np.arange(SIDE)] * 3, indexing="ij"), -1).reshape(-1, 3) + 0.5)
    x = np.concatenate([cube + DX * np.array(corner, float) for corner in corners])
    body = np.repeat(np.arange(len(corners)), len(cube))
    velocity = np.array(velocities, float)[body]
    return make_particles(jnp.asarray(x), volume=(DX / 2) ** 3, table=TABLE, velocity=jnp.asarray(velocity), body=body)


def simulate(particles, *, frames, sleep=None, gravity=NO_GRAVITY, frame_dt=0.02, colliders=(), substeps=16, **config):
    settings = SimConfig(substeps=substeps, devices=1, **config)
    return rollout(
        particles, vast_grid(DX), TABLE, settings, frames=frames, frame_dt=frame_dt, gravity=gravity,
        colliders=colliders, sleep=sleep,
    )  # fmt: skip


@pytest.fixture
def simulated(monkeypatch):
    """Particles of each frame that was computed."""
    counts, whole = [], ActiveGrid.frame

    def counted(self, particles, *args):
        counts.append(len(particles))
        return whole(self, particles, *args)

    monkeypatch.setattr(ActiveGrid, "frame", counted)
    return counts


def test_a_block_hit_by_another_moves_as_if_it_had_never_slept(x64, simulated):
    """The same to 1e-9 of a metre, with the row left out until one frame's way and the reach of both before contact."""
    row = cubes([(0, 0, 0), (2, 0, 0), (14, 0.3, 0.2)], [(0, 0, 0), (0, 0, 0), (-2.0, 0, 0)])
    end, path, health = simulate(row, frames=24, sleep=Sleep(frames=2))
    counts = list(simulated)
    plain, plain_path, plain_health = simulate(row, frames=24)
    print("simulated, frame by frame:", counts)
    for name in ("x", "v", "F", "C"):
        np.testing.assert_allclose(getattr(end, name), getattr(plain, name), atol=1e-9, err_msg=name)
    for name in ("x", "v", "F_visual"):
        np.testing.assert_allclose(getattr(path, name), getattr(plain_path, name), atol=1e-9, err_msg=name)
    assert counts[:3] == [192, 192, 64]
    woken = counts.index(192, 2)
    assert counts == [192] * 2 + [64] * (woken - 2) + [192] * (24 - woken)
    assert woken > 7
    assert float(jnp.abs(plain_path.x[woken - 1, :128] - row.x[:128]).max()) < 1e-12  # nothing had touched it
    assert float(jnp.abs(end.x[:64] - row.x[:64]).max()) > 0.2 * DX  # the push went through to the second one
    assert float(health.max_courant) == pytest.approx(float(plain_health.max_courant))


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("warp") is None, reason="needs warp-lang")
@pytest.mark.parametrize("whole", [True, False], ids=["whole frames", "transfers"])
def test_bodies_sleep_and_wake_on_warp_as_under_xla(x64, simulated, whole):
    """Two move and rest, and one of them is hit: the same bodies are left out of the same frames."""
    row = cubes([(0, 0, 0), (2, 0, 0), (10, 0.3, 0.2)], [(0, 0, 0), (0, 0, 0), (-2.0, 0, 0)])
    found, counts = [], []
    for config in ({"backend": "warp", "whole_frames": whole}, {"backend": "xla"}):
        end, path, _ = simulate(row, frames=14, sleep=Sleep(frames=2), **config)
        found.append((end.x, end.v, end.F, end.C, path.x))
        counts.append(simulated[:])
        simulated.clear()
    assert counts[0] == counts[1]
    assert counts[0][2] == 64
    assert counts[0][-1] == 192
    for own, other in zip(*found):
        np.testing.assert_allclose(
            own, other, rtol=0, atol=1e-10 * float(jnp.abs(other).max())
        )  # rounding of 224 steps


def test_what_gets_farther_than_its_speed_told_wakes_others_in_the_same_frame(x64, simulated):
    """A squeezed block at rest bursts within one frame onto a sleeping one beyond its reach."""
    pair = cubes([(0, 0, 0), (5.2, 0, 0)], [(0, 0, 0)] * 2)
    squeezed = jnp.where(jnp.arange(128)[:, None, None] >= 64, 0.35, 1.0) * pair.F
    pair = eqx.tree_at(lambda p: p.F, pair, squeezed)
    inputs = StepInputs(jnp.asarray(0.05 / 128), 128, jnp.zeros(3), jnp.zeros(()))
    sleeper = Sleeper(settings=Sleep(), body=np.asarray(pair.body), slack=50.0)  # the whole domain: one box for all
    sleeper.asleep[0], sleeper.still[0] = True, 9
    config = SimConfig(devices=1)
    domain = Grid(jnp.full(3, -6 * DX), jnp.asarray(DX), (20, 16, 16))
    moved, _, _ = sleeper.frame(pair, domain, TABLE, config, 1, inputs)
    assert simulated == [64, 128]
    assert not sleeper.asleep.any()
    plain, _, _ = ActiveGrid(slack=50.0).frame(pair, domain, TABLE, config, 1, inputs)
    np.testing.assert_allclose(moved.x, plain.x, atol=1e-9)
    assert float(jnp.abs(plain.x[:64] - pair.x[:64]).max()) > 0.01 * DX


def test_a_block_comes_to_rest_on_a_floor_and_a_moving_ball_wakes_it(x64, simulated):
    """Asleep its velocity is zero and it stays within 0.02 cells of where it would have been; then it is thrown."""
    floor = Plane(point=jnp.asarray([0.0, 0.0, -0.01 * DX]), normal=jnp.asarray([0.0, 0.0, 1.0]))
    bat = Sphere(jnp.asarray([-3.3, DX, DX]), 0.1, velocity=jnp.asarray([2.0, 0.0, 0.0]))
    block = cubes([(0, 0, 0)], [(0, 0, 0)])
    setup = {"frames": 90, "gravity": (0.0, 0.0, -2.0), "colliders": (floor, bat)}
    end, path, _ = simulate(block, sleep=Sleep(speed=0.01), **setup)
    counts = len(simulated)
    plain, plain_path, _ = simulate(block, **setup)
    asleep = (np.asarray(path.v) == 0).all((1, 2))
    first, last = np.flatnonzero(asleep)[[0, -1]]
    off = float(jnp.abs(path.x[: last + 1] - plain_path.x[: last + 1]).max()) / DX
    print(f"asleep in frames {first} to {last} of 90, {counts} computed; off by {off:.4f} cells")
    assert asleep[first : last + 1].all()
    assert counts == 90 - asleep.sum()
    assert last - first > 20
    assert off < 0.02
    assert last < 85
    assert float(jnp.abs(path.x[last] - path.x[first]).max()) == 0
    np.testing.assert_allclose(end.v.mean(0), plain.v.mean(0), atol=0.05)
    assert float(end.v[:, 0].mean()) > 1.0


def test_a_block_let_go_in_the_air_does_not_fall_asleep_there(x64):
    """In five short frames it would be slower than the limit: it is watched for as long as falling needs."""
    block = cubes([(0, 0, 0)], [(0, 0, 0)])
    setup = {"frames": 30, "gravity": (0.0, 0.0, -9.8), "frame_dt": 1e-3, "substeps": 1}
    end, _, _ = simulate(block, sleep=Sleep(speed=2e-3, frames=2), **setup)
    np.testing.assert_allclose(end.v[:, 2], -9.8 * 0.03, rtol=1e-9)


def test_a_simulation_goes_on_from_what_the_sleeper_remembers(x64):
    row = cubes([(0, 0, 0), (2, 0, 0), (14, 0.3, 0.2)], [(0, 0, 0), (0, 0, 0), (-2.0, 0, 0)])
    inputs = StepInputs(jnp.asarray(0.02 / 16), 16, jnp.zeros(3), jnp.zeros(()))

    def run(sleeper, particles, frames):
        for frame in frames:
            now = inputs._replace(start=jnp.asarray(0.02 * frame))
            particles, *_ = sleeper.frame(particles, vast_grid(DX), TABLE, SimConfig(devices=1), 1, now)
        return particles

    def fresh():
        return Sleeper(settings=Sleep(frames=2), body=np.asarray(row.body))

    through = fresh()
    end = run(through, row, range(6))
    halted, later = fresh(), fresh()
    half = run(halted, row, range(3))
    later.remember(halted.memory())
    assert later.asleep.tolist() == [True, True, False]
    resumed = run(later, half, range(3, 6))
    for a, b in zip(jax.tree.leaves(end), jax.tree.leaves(resumed)):
        assert_same(a, b, 1e-12)
    np.testing.assert_array_equal(through.memory(), later.memory())


def test_sleep_is_refused_where_it_cannot_be_decided_and_bad_numbers_are_named():
    row = cubes([(0, 0, 0)], [(0, 0, 0)])
    with pytest.raises(InputError, match="cannot be decided who sleeps: give sleep=None"):
        jax.jit(lambda p: simulate(p, frames=1, sleep=Sleep()))(row)
    with pytest.raises(InputError, match=r"Sleep.speed = 0.0: must be > 0"):
        Sleep(speed=0.0)
    with pytest.raises(InputError, match=r"Sleep.frames = 0: must be 1 or more"):
        Sleep(frames=0)
    with pytest.raises(SceneError, match=r"simulation.sleep = -1.0: it must be > 0"):
        scene_from(values(simulation__sleep=-1.0))


def test_a_killed_scene_with_a_sleeper_resumes_to_the_same_states(tmp_path):
    """A ball without gravity sleeps from the sixth frame on."""
    io.save_ply(tmp_path / "cloud.ply", ball(150))
    content = values(simulation__sleep=0.01)
    content["simulation"] |= {"gravity": 0.0, "frames": 8}
    scene = scene_from(content, folder=tmp_path)

    class Killed(Exception):
        pass

    def kill_at(place):
        def told(stage, done, of):
            if (stage, done) == place:
                raise Killed

        return told

    for folder, place in (("a", ("simulate", 6)), ("a", ("draw", 0)), ("b", ("draw", 0))):
        with pytest.raises(Killed):
            run_scene(scene, tmp_path / folder, progress=kill_at(place))
    states = [io.load_state(tmp_path / folder / "states", 8) for folder in ("a", "b")]
    for name in ("x", "v", "F_visual"):
        assert_same(states[0][name], states[1][name], 1e-4)
    report = io.read_json(tmp_path / "a" / "report.json")
    assert report["sizes"]["asleep_at_the_end"] == 1
    assert report["sizes"]["resumed_from_frame"] == 6
