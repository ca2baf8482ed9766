"""Picture quality and time when the least seen Gaussians go: `python benchmarks/bench_prune.py`.

The bundled tabletop is pruned by its training views and scored on the held-out ones, beside the same number of
Gaussians drawn by chance and by opacity.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from benchmarks.common.timing import machine, measure
from jax import lax

from pigjax import load_ply, load_views, prune, psnr, render

TABLETOP = Path(__file__).parents[1] / "examples" / "tabletop"
views = load_views(TABLETOP, background=1.0)
train, test = views.subset("train"), views.subset("test")
gaussians = load_ply(TABLETOP / "tabletop.ply")


def held_out(gaussians):
    def one(pair):
        camera, image = pair
        return psnr(jnp.clip(render(gaussians, camera, background=1.0).rgb, 0, 1), image)

    return jnp.mean(lax.map(one, (test.cameras, jnp.asarray(test.images))))


def subset(indices):
    return jax.tree.map(lambda values: values[np.sort(indices)], gaussians)


print(machine())
rng = np.random.default_rng(0)
order = np.argsort(-np.asarray(gaussians.logit_opacities))
for share in (1.0, 0.9, 0.75, 0.6, 0.5, 0.33):
    budget = int(share * len(gaussians))
    candidates = {
        "contribution": prune(gaussians, train, budget),
        "opacity": subset(order[:budget]),
        "chance": subset(rng.permutation(len(gaussians))[:budget]),
    }
    line = f"{budget:6d} of {len(gaussians)}"
    for name, kept in candidates.items():
        _, seconds, score = measure(held_out, kept, repeats=3)
        line += f"  {name} {float(score):.2f} dB" + (f" {seconds / len(test) * 1e3:.1f} ms" * (name == "contribution"))
    print(line, flush=True)
