"""A real capture as shot and as undistorted by COLMAP: one reconstruction. Wants `PIGJAX_REAL_DATA=folder of plush`."""

import os
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from pigjax.core.metrics import psnr
from pigjax.io import load_points, load_views
from pigjax.reconstruction.reconstruct import FitConfig, reconstruct
from pigjax.splat import render

DATA = Path(os.environ.get("PIGJAX_REAL_DATA", "nowhere")) / "plush"


@pytest.mark.slow
@pytest.mark.skipif(not DATA.is_dir(), reason="PIGJAX_REAL_DATA names no folder with the capture plush")
def test_photos_as_shot_give_the_reconstruction_of_undistorted_ones():
    """Both are scored on the undistorted photos, 3 of 12 held out; the capture is plush of the issue on real photos."""
    shot = load_views(DATA / "distorted", max_size=128, hold_out=4)
    straight = load_views(DATA, only=list(shot.names), max_size=128)
    points = load_points(shot.points_path)
    config = FitConfig(steps=250, splats=3000, sh_degree=0, evaluate_every=250, background=0.5)
    held_out = [straight.names.index(name) for name in shot.held_out.names]
    trained = [i for i in range(len(straight)) if i not in held_out]
    scores = {}
    for name, views in (("as shot", shot.training), ("undistorted", straight[trained])):
        result = reconstruct(views, config, points=points)
        found = []
        for i in held_out:
            rgb = jnp.clip(render(result.gaussians, straight.cameras[i], background=0.5).rgb, 0, 1)
            found.append(float(psnr(rgb, jnp.asarray(straight.images[i]))))
        scores[name] = float(np.mean(found))
    print(scores)
    assert abs(scores["as shot"] - scores["undistorted"]) < 0.2
