"""Pictures of the ablation: a row of images with an inset where the modes differ most, and heat maps."""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from scipy.ndimage import uniform_filter

_INSET = 5  # the inset's side is this part of the image's


def write_row(path: Path, frames: dict) -> None:
    """Images by name, the first of them the reference, each over its inset."""
    images = {name: np.clip(np.asarray(frame.rgb), 0, 1) for name, frame in frames.items()}
    reference = images["reference"]
    side = len(reference) // _INSET
    # "fixed" and "literal" fail everywhere; the inset shows the worst place of the two serious modes
    wrong = np.mean([np.abs(images[name] - reference).mean(-1) for name in ("covariance", "aligned")], 0)
    half = side // 2
    inner = uniform_filter(wrong, side)[half : len(wrong) - side + half, half : len(wrong) - side + half]
    top, left = np.unravel_index(np.argmax(inner), inner.shape)
    figure, axes = plt.subplots(2, len(images), figsize=(2.1 * len(images), 4.4), layout="constrained")
    for column, (name, image) in enumerate(images.items()):
        axes[0, column].imshow(image)
        axes[0, column].add_patch(plt.Rectangle((left, top), side, side, fill=False, edgecolor="k", linewidth=0.8))
        axes[0, column].set_title(name, fontsize=10)
        axes[1, column].imshow(image[top : top + side, left : left + side], interpolation="nearest")
    for axis in axes.flat:
        axis.set_xticks([])
        axis.set_yticks([])
    figure.savefig(path, dpi=90)
    plt.close(figure)


def write_heat(path: Path, by_lambda, by_tau) -> None:
    """PSNR over lambda_R × lambda_S with the paper's and the best, and over tau_max × tau_min."""
    values, psnr, best = by_lambda
    figure, (left, right) = plt.subplots(1, 2, figsize=(8.4, 3.4), layout="constrained")
    drawn = left.pcolormesh(values, values, psnr.T, shading="nearest")
    left.plot(1.2, 0.8, "rx", label="paper")
    left.plot(*best, "w*", label="best")
    left.set(xlabel="lambda_R", ylabel="lambda_S", title="PSNR [dB], tau 0.5 to 2")
    left.legend(fontsize=8, loc="lower left")
    figure.colorbar(drawn)
    high, low, psnr = by_tau
    drawn = right.pcolormesh(high, low, psnr.T, shading="nearest")
    right.plot(2, 0.5, "rx")
    right.set(xscale="log", yscale="log", xlabel="tau_max", ylabel="tau_min", title="PSNR [dB], lambdas of 1")
    figure.colorbar(drawn)
    figure.savefig(path, dpi=90)
    plt.close(figure)
