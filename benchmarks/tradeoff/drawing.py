"""Drawing: the last frame of each scene against the exact setting in float64, over the renderer's knobs."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.common.timing import in_turn
from benchmarks.tradeoff.errors import enlarged, root_mean_square, video_psnr
from benchmarks.tradeoff.points import Point, by_scene, said_windows
from benchmarks.tradeoff.scenes import as_float64, picture, pose, simulate, source
from pigjax import prune
from pigjax.scene.plan import make_cameras
from pigjax.splat import RenderConfig, required_capacity

PLOT = "tradeoff_drawing.png"
EXACT = {"alpha_min": 1e-6, "transmittance_min": 0.0}
CONFIGS = {
    "standard": ("standard", {}),
    "T ≥ 1e-2": ("transmittance_min", {"transmittance_min": 1e-2}),
    "T ≥ 1e-1": ("transmittance_min", {"transmittance_min": 1e-1}),
    "T ≥ 1e-6": ("transmittance_min", {"transmittance_min": 1e-6}),
    "alpha ≥ 1/64": ("alpha_min", {"alpha_min": 1 / 64}),
    "alpha ≥ 1e-4": ("alpha_min", {"alpha_min": 1e-4}),
    "exact, float32": ("alpha_min", EXACT),
    "SH 0": ("SH degree", {"sh_degree": 0}),
    "SH 1": ("SH degree", {"sh_degree": 1}),
}
WINDOWS = 7
SCALES, KEPT, ROOM = (0.75, 0.5), (0.75, 0.5), 0.8


def study(options) -> str:
    """Tables of all scenes and one plot."""
    print(
        f"{said_windows(WINDOWS)} "
        "One picture of the deformed scene. Reference: the exact setting (alpha ≥ 1e-6, no early stop) in float64. Of a"
        " smaller picture the error is measured after enlargement.\n"
    )
    return by_scene(options, lambda name: (_study(name), None, ""), PLOT, error="RMS error of colour")


def _study(name):
    of = source(name)
    scene = of.scene()
    plan, gaussians = of.plan(scene), of.inputs.gaussians
    _, path = simulate(scene, plan)
    state = path.x[-1], path.F_visual[-1], plan.clamp
    splats = pose(gaussians, plan.particles, *state, plan.binding, scene.clamp.mode)
    cameras = make_cameras(scene, of.inputs, np.asarray(plan.particles.x).mean(0))
    camera, background = cameras[-1], jnp.asarray(scene.camera.background)
    base = RenderConfig(bands=jax.local_device_count())
    runs, knobs = {}, {}

    def add(key, knob, splats=splats, camera=camera, config=base):
        knobs[key] = knob
        runs[key] = lambda: picture(splats, camera, config, background)

    for key, (knob, fields) in CONFIGS.items():
        add(key, knob, config=replace(base, **fields))
    for scale in SCALES:
        size = round(scale * camera.width), round(scale * camera.height)
        add(f"{scale:g} of the size", "resolution", camera=camera.resized(*size))
    for share in KEPT:
        fewer = prune(gaussians, cameras[:: max(len(cameras.world_to_cam) - 1, 1)], round(share * len(gaussians)))
        kept = _rows_of(fewer, gaussians)
        add(f"{share:.0%} of the splats", "splats", splats=jax.tree.map(lambda leaf, kept=kept: leaf[kept], splats))
    needed = required_capacity(splats, camera, base)
    add(f"{ROOM:g} of the tile lists", "capacity", config=replace(base, capacity=int(ROOM * needed)))
    with jax.enable_x64(True):
        double = as_float64((splats, camera, background))
        exact = np.asarray(picture(double[0], double[1], replace(base, **EXACT), double[2]))
        double = jax.block_until_ready(double)

    def in_float64():
        with jax.enable_x64(True):
            return picture(double[0], double[1], base, double[2])

    runs["float64"], knobs["float64"] = in_float64, "precision"
    points = []
    for key, timed in in_turn(runs, windows=WINDOWS).items():
        image = np.asarray(timed.result)
        psnr, most = video_psnr(image[None], exact[None]), float(np.max(np.abs(_as_large(image, exact) - exact)))
        note = f"PSNR {psnr:.1f} dB, at most {most:.1e}"
        error = root_mean_square(image[None], exact[None])
        points.append(Point(key, knobs[key], timed.seconds, error, timed.compile_seconds, note))
    return points


def _as_large(image, like):
    return enlarged(image[None].astype(np.float64), like.shape[:2])[0]


def _rows_of(fewer, gaussians):
    """Where the Gaussians that are left stood; `prune` keeps their order."""
    place = {row.tobytes(): number for number, row in enumerate(np.asarray(gaussians.means))}
    return np.array([place[row.tobytes()] for row in np.asarray(fewer.means)])
