"""One image shared by several local devices: splats are sharded to be projected, rows of tiles to be composited.

On a CPU, XLA runs the loop over tiles on one core; with one host device per core it runs on all of them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float, Int

from pigjax.core.errors import InputError
from pigjax.splatting.binning import BlendConfig, Boxes

_AXIS = "shards"
Tree = TypeVar("Tree")


def shard_rows(composite: Callable) -> Callable:
    """`composite` on several devices, each of which draws its share of the image's rows of tiles.

    Args:
        composite: `(table, boxes, tau, config) -> (planes [tiles c p], overflow)`; the result has the same signature.
    """

    def sharded(
        table: Float[Array, "n f"], boxes: Boxes, tau: Float[Array, ""], config: BlendConfig
    ) -> tuple[Float[Array, "tiles c p"], Int[Array, ""]]:
        height = -(-config.rows // config.shards) * config.tile
        shard = dataclasses.replace(config, height=height, shards=1)

        def one(table, boxes, tau):
            top = lax.axis_index(_AXIS) * shard.rows
            low = jnp.clip(boxes.low[:, 1] - top, 0, shard.rows)
            high = jnp.clip(boxes.low[:, 1] + boxes.size[:, 1] - top, 0, shard.rows)
            seen = Boxes(boxes.order, boxes.low.at[:, 1].set(low), boxes.size.at[:, 1].set(high - low))
            planes, overflow = composite(table.at[:, 1].add(-(top * shard.tile).astype(table.dtype)), seen, tau, shard)
            return planes, overflow[None]

        # outputs are sharded, inputs replicated; the carries of the loops would need marks to have that checked
        mesh = device_mesh(config.shards)
        drawn = jax.shard_map(one, mesh=mesh, in_specs=PartitionSpec(), out_specs=PartitionSpec(_AXIS), check_vma=False)
        planes, overflow = drawn(table, boxes, tau)
        return planes, overflow.sum()

    return sharded


def replicate(tree: Tree, shards: int) -> Tree:
    """Arrays put whole on each of the devices (host), so that later calls find them where they are needed."""
    return tree if shards == 1 else jax.device_put(tree, NamedSharding(device_mesh(shards), PartitionSpec()))


def shard_splats(tree: Tree, shards: int) -> Tree:
    """Rows of the arrays distributed over the devices, so that each works on its share of the splats."""
    return _constrain(tree, shards, PartitionSpec(_AXIS))


def all_gather(tree: Tree, shards: int) -> Tree:
    """Sharded arrays whole on each of the devices."""
    return _constrain(tree, shards, PartitionSpec())


def _constrain(tree: Tree, shards: int, spec: PartitionSpec) -> Tree:
    return tree if shards == 1 else lax.with_sharding_constraint(tree, NamedSharding(device_mesh(shards), spec))


def device_mesh(shards: int) -> Mesh:
    """The first local devices, one for each shard.

    Raises:
        InputError: there are fewer devices.
    """
    devices = jax.local_devices()
    if shards > len(devices):
        raise InputError(
            f"RenderConfig.bands = {shards}: JAX has {len(devices)} local devices; on a CPU set"
            f' jax.config.update("jax_num_cpu_devices", {shards}) before anything else.'
        )
    return Mesh(np.array(devices[:shards]), (_AXIS,))
