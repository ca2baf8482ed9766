"""One image drawn by several local devices: the splats are dealt out to be projected, the rows of tiles to be blended.

On a CPU, XLA runs the loop over tiles on one core; with one host device per core it runs on all of them.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from pigjax.core.errors import InputError
from pigjax.splatting.binning import BlendConfig, Boxes

_AXIS = "bands"


def in_bands(composite):
    """The same on several devices, each of which draws a band of the image's rows of tiles."""

    def sharded(table, boxes: Boxes, tau, config: BlendConfig):
        height = -(-config.rows // config.bands) * config.tile
        band = dataclasses.replace(config, height=height, bands=1)

        def one(table, boxes, tau):
            top = lax.axis_index(_AXIS) * band.rows
            low = jnp.clip(boxes.low[:, 1] - top, 0, band.rows)
            high = jnp.clip(boxes.low[:, 1] + boxes.size[:, 1] - top, 0, band.rows)
            seen = Boxes(boxes.order, boxes.low.at[:, 1].set(low), boxes.size.at[:, 1].set(high - low))
            planes, overflow = composite(table.at[:, 1].add(-(top * band.tile).astype(table.dtype)), seen, tau, band)
            return planes, overflow[None]

        # outputs are per band, inputs the same for all; the loops' carries would need marks to have that checked
        mesh = band_mesh(config.bands)
        drawn = jax.shard_map(one, mesh=mesh, in_specs=PartitionSpec(), out_specs=PartitionSpec(_AXIS), check_vma=False)
        planes, overflow = drawn(table, boxes, tau)
        return planes, overflow.sum()

    return sharded


def replicate(tree, bands: int):
    """Arrays put whole on each device of the bands (host), so that later calls find them where they are needed."""
    return tree if bands == 1 else jax.device_put(tree, NamedSharding(band_mesh(bands), PartitionSpec()))


def spread(tree, bands: int):
    """Rows of the arrays dealt out to the devices of the bands, so that each works on a share of the splats."""
    return _constrain(tree, bands, PartitionSpec(_AXIS))


def collect(tree, bands: int):
    """Arrays whole on each device of the bands."""
    return _constrain(tree, bands, PartitionSpec())


def _constrain(tree, bands: int, spec: PartitionSpec):
    return tree if bands == 1 else lax.with_sharding_constraint(tree, NamedSharding(band_mesh(bands), spec))


def band_mesh(bands: int) -> Mesh:
    """The first local devices, one for each band.

    Raises:
        InputError: there are fewer devices.
    """
    devices = jax.local_devices()
    if bands > len(devices):
        raise InputError(
            f"RenderConfig.bands = {bands}: JAX has {len(devices)} local devices; on a CPU set"
            f' jax.config.update("jax_num_cpu_devices", {bands}) before anything else.'
        )
    return Mesh(np.array(devices[:bands]), (_AXIS,))
