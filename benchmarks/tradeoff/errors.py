"""How wrong an answer is, against a reference."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import zoom

from pigjax.core.metrics import ssim


class Displacement(NamedTuple):
    """Errors of tracer points, as shares of the distance that they travelled (root mean squares)."""

    total: float
    centre: float  # of the centre of mass of each body
    shape: float  # the rest, without the centres


def distance_travelled(path) -> float:
    """Root mean square over points of the length of their path [t p 3], the start included.

    Matter that bounces ends near its start, so the distance between the two would measure nothing.
    """
    steps = np.linalg.norm(np.diff(np.asarray(path, np.float64), axis=0), axis=2)
    return float(np.sqrt(np.mean(steps.sum(0) ** 2)))


def displacement_error(x, reference, travelled, body) -> Displacement:
    """Positions after the same time [p 3], those of the reference, its distance, and the body of each point [p].

    Points count alike; total² = centre² + shape².
    """
    x, reference = (np.asarray(a, np.float64) for a in (x, reference))
    body = np.asarray(body)
    difference, centre = x - reference, np.empty_like(x)
    for number in np.unique(body):
        centre[body == number] = difference[body == number].mean(0)
    sizes = [np.sqrt(np.mean(np.sum(d**2, 1))) / travelled for d in (difference, centre, difference - centre)]
    return Displacement(*(float(size) for size in sizes))


def video_psnr(frames, reference) -> float:
    """PSNR [dB] over all pixels of all frames [t h w 3] in [0, 1]; smaller frames are first enlarged, bilinearly."""
    reference = np.asarray(reference, np.float64)
    frames = enlarged(np.asarray(frames, np.float64), reference.shape[1:3])
    return float(-10 * np.log10(np.mean((frames - reference) ** 2)))


def video_ssim(frames, reference) -> float:
    """Mean structural similarity of all frames [t h w 3] in [0, 1]; smaller frames are first enlarged."""
    reference = jnp.asarray(reference)
    frames = jnp.asarray(enlarged(np.asarray(frames, np.float64), reference.shape[1:3]), reference.dtype)
    return float(np.mean([_ssim(frame, of) for frame, of in zip(frames, reference)]))


_ssim = jax.jit(ssim)


def root_mean_square(frames, reference) -> float:
    """Of the difference of colours in [0, 1]: 10^(-PSNR/20)."""
    return 10 ** (-video_psnr(frames, reference) / 20)


def enlarged(frames, size) -> np.ndarray:
    """Frames [t h w 3] at another size (h, w), linear between pixel centres, edges repeated."""
    factors = [new / old for new, old in zip(size, frames.shape[1:3])]
    return zoom(frames, (1, *factors, 1), order=1, mode="nearest", grid_mode=True)


def share_right(found, truth) -> float:
    """Share of Gaussians with their true id."""
    return float(np.mean(np.asarray(found) == np.asarray(truth)))
