"""Foams, creams and muds: elastic until they yield, then Herschel–Bulkley flow (Yue et al. 2015, doi 10.1145/2751541).

Strain is Hencky's, as in the plastic laws, where the paper has the left Cauchy–Green tensor without its volume.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from pigjax.mpm.materials.parameters import Parameters
from pigjax.mpm.materials.tensors import Scalar, Scalars, length

Strains = Float[Array, "3 *n"]

_NEWTON_STEPS = 7  # from above: six leave 4e-16 for flow exponents of 0.1 to 10


def herschel_bulkley(strain: Strains, dt: Scalar, m: Parameters) -> Strains:
    """Principal strains [3 *n] after dt [s] of flow at the rate ((s − s_y) / η)^(1/h) of shear, from the trial ones.

    In lasting shear s = s_y + η γ̇^h, with s the shear stress ‖dev τ‖/√2 [Pa], γ̇ the rate of engineering shear [1/s],
    η the viscosity [Pa sʰ], h the flow exponent, and s_y = yield_stress/√3, the yield stress being uniaxial as in every
    law. The step is implicit and may be long against η/μ: x + μ dt (x/η)^(1/h) = s_trial − s_y with x = s − s_y.
    """
    mean = strain.mean(0)
    deviatoric = strain - mean
    shear = 2**0.5 * m.mu * length(deviatoric)
    limit = m.yield_stress / 3**0.5
    flows = (shear > limit) & (dt > 0)
    excess = _relaxed(jnp.where(flows, shear - limit, 1.0), m.mu * jnp.where(dt > 0, dt, 1.0), m)
    kept = jnp.where(flows, (limit + excess) / jnp.where(flows, shear, 1.0), 1.0)
    return mean + deviatoric * kept


def _relaxed(excess: Scalars, impulse: Array, m: Parameters) -> Scalars:
    """Root x of x + impulse (x/η)^(1/h) = excess, where excess > 0 and impulse = μ dt > 0.

    In x where flow thins (h <= 1), in the shear impulse (x/η)^(1/h) where it thickens, the equation is the convex one
    of `_root`, in shares of the excess. Logarithms keep the powers in range.
    """
    h = m.flow_exponent
    thins = h <= 1
    log_excess, log_impulse, log_viscosity = jnp.log(excess), jnp.log(impulse), jnp.log(m.viscosity)
    thinning = log_impulse + (log_excess - log_viscosity) / h - log_excess
    thickening = log_viscosity + h * (log_excess - log_impulse) - log_excess
    share = _root(jnp.where(thins, thinning, thickening), jnp.where(thins, 1 / h, h))
    return excess * jnp.where(thins, share, 1 - share)


def _root(log_a: Array, p: Array) -> Array:
    """Root y in [0, 1] of y + a yᵖ = 1 with p >= 1, in closed form for p = 1, else by Newton's method from above.

    y = k c with k = min(1, a^(−1/p)), so that c is in [1/2, 1]. Only the last two iterations carry derivatives.
    """
    log_a, p = jnp.broadcast_arrays(log_a, p)
    a, k = jnp.exp(jnp.minimum(log_a, 0.0)), jnp.exp(-jnp.maximum(log_a, 0.0) / p)

    def newton(c, a, k, p):
        power = a * c ** (p - 1)
        return c - (power * c + k * c - 1) / (p * power + k)

    fixed = jax.tree.map(lax.stop_gradient, (a, k, p))
    c = lax.fori_loop(0, _NEWTON_STEPS - 2, lambda _, c: newton(c, *fixed), jnp.ones_like(fixed[0]))
    return k * newton(newton(c, a, k, p), a, k, p)
