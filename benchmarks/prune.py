"""Pruning: picture quality and time when the least seen Gaussians go.

The bundled tabletop is pruned by its training views and scored on the held-out ones, beside the same number of
Gaussians drawn by chance and by opacity.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from benchmarks.common.pages import TABLETOP, head, row
from benchmarks.common.timing import in_turn
from pigjax import load_ply, load_views, prune, psnr, render


def compare(options):
    """Print the scores of each choice for each share that is kept."""
    views = load_views(TABLETOP, background=1.0)
    train, test = views.subset("train"), views.subset("test")
    gaussians = load_ply(TABLETOP / "tabletop.ply")
    rng, order = np.random.default_rng(0), np.argsort(-np.asarray(gaussians.logit_opacities))

    @jax.jit
    def held_out(kept):
        def one(pair):
            camera, image = pair
            return psnr(jnp.clip(render(kept, camera, background=1.0).rgb, 0, 1), image)

        return jnp.mean(lax.map(one, (test.cameras, jnp.asarray(test.images))))

    def subset(indices):
        return jax.tree.map(lambda values: values[np.sort(indices)], gaussians)

    print(head("Gaussians", "by contribution [dB]", "by opacity [dB]", "by chance [dB]", "ms a picture"))
    for share in options.shares:
        budget = int(share * len(gaussians))
        kept = {
            "contribution": prune(gaussians, train, budget),
            "opacity": subset(order[:budget]),
            "chance": subset(rng.permutation(len(gaussians))[:budget]),
        }
        found = in_turn({name: (lambda kept=kept: held_out(kept)) for name, kept in kept.items()}, windows=3)
        scores = [f"{float(run.result):.2f}" for run in found.values()]
        print(row(f"{budget} of {len(gaussians)}", *scores, f"{found['contribution'].seconds / len(test) * 1e3:.1f}"))


PARTS = {"budgets": ("Pruning", compare)}
OPTIONS = {
    "shares": {"nargs": "+", "type": float, "default": [1.0, 0.9, 0.75, 0.6, 0.5, 0.33], "help": "that are kept"}
}
