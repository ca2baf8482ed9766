"""Forces on matter beside gravity: wind, fields in a region, impulses and springs.

A force changes the velocities of particles before they are transferred to the grid (P2G), so that contact, colliders
and walls of the same step answer to it. A force that a scene does not have is not traced. All numbers may be
differentiated, but for the place of a region, whose boundary is hard.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from pigjax.core.arguments import checked
from pigjax.core.arrays import Vector, as_real, is_known, static_field
from pigjax.core.checks import Limits, check_fields
from pigjax.core.errors import InputError
from pigjax.core.linalg import safe_norm
from pigjax.core.regions import Region
from pigjax.mpm.particles import Particles

Points = Float[Array, "*n 3"]
Scalar = Float[Array, ""]
Time = Float[Array, ""] | float
_WAVES = 4  # of a gusty wind


def _number(limits: Limits | None = None, **kwargs: Any) -> Any:
    """Dynamic field of real numbers, or None; integers become real."""
    return eqx.field(converter=as_real, metadata={"limits": limits}, **kwargs)


class Matter(NamedTuple):
    """Particles of one law, as a force meets them."""

    x: Float[Array, "*n 3"]  # [m]
    v: Float[Array, "*n 3"]  # [m/s]
    mass: Float[Array, "*n 1"]  # [kg]; 0 for particles that take no part
    weight: Float[Array, "*n 1"]  # share to which the force acts on each: 0 outside of its region


class Force(eqx.Module):
    """Base of all forces. Subclass it and write `acceleration_of` for a force of your own.

    A force acts on the particles of its `region`, as strongly as their `weights` say, from `start` to `end`; a step in
    which it begins or ends counts in part. Fields that are None are not traced.

    Attributes:
        weights: of each particle, 0 where the force does not act; None, the default: 1 for all.
        region: where it acts (`BoxRegion`, `SphereRegion`, `HalfSpace`); None, the default: everywhere.
        start: when it begins [s]; None, the default: it always has.
        end: when it ends [s]; None, the default: never.
        elapsed: time since the moment that `start` and `end` count from [s]; `after` sets it.

    Raises:
        InputError: a number is not finite or out of range, or `end` is before `start`.
    """

    weights: Float[Array, "p"] | None = _number(Limits(0, 1e9), default=None, kw_only=True)
    region: Region | None = eqx.field(default=None, kw_only=True)
    start: Scalar | None = _number(Limits(-1e9, 1e9, unit="s"), default=None, kw_only=True)
    end: Scalar | None = _number(Limits(-1e9, 1e9, unit="s"), default=None, kw_only=True)
    elapsed: Scalar = _number(Limits(-1e9, 1e9, unit="s"), default=0.0, kw_only=True)

    def __check_init__(self) -> None:
        check_fields(self)
        name = type(self).__name__
        if self.region is not None and not isinstance(self.region, Region):
            raise InputError(
                f"{name}.region is {type(self.region).__name__}: give a BoxRegion, SphereRegion, HalfSpace."
            )
        start, end = self.start, self.end
        if start is not None and end is not None and is_known((start, end)) and float(end) < float(start):
            raise InputError(f"{name}.end = {float(end)}: it must not be before start = {float(start)} s.")

    def acceleration_of(self, x: Points, v: Points, time: Time) -> Points:
        """Acceleration of matter [m/s²].

        Args:
            x: positions [m].
            v: velocities [m/s].
            time: [s].
        """
        raise NotImplementedError(f"{type(self).__name__} must define acceleration_of(x, v, time).")

    def totals(self, matter: Matter) -> Any:
        """Sums over matter that `change` needs, such as its mass: a pytree that adds up over laws and devices."""
        return ()

    def change(self, matter: Matter, totals: Any, dt: Time, time: Time) -> Points:
        """Change of the velocities [m/s] in a step.

        Args:
            matter: of one law.
            totals: of all matter.
            dt: the step [s].
            time: when it begins, since the start of the rollout [s].
        """
        return self.acting(dt, time) * matter.weight * self.acceleration_of(matter.x, matter.v, self.elapsed + time)

    def acting(self, dt: Time, time: Time) -> Time:
        """Part [s] of a step of `dt`, begun at a time [s] since the start of the rollout, in which the force acts."""
        now, acting = self.elapsed + time, dt
        if self.start is not None:
            acting = jnp.clip(now + dt - self.start, 0.0, dt)
        if self.end is not None:
            before_end = jnp.clip(self.end - now, 0.0, dt)
            acting = before_end if self.start is None else jnp.maximum(acting + before_end - dt, 0.0)
        return acting

    def after(self, duration: Time) -> Force:
        """The force as it will be after a duration [s], to go on from a rollout of that length."""
        return eqx.tree_at(lambda force: force.elapsed, self, self.elapsed + duration)

    def speed_gain(self, particles: Particles, time: float, duration: float, reach: float) -> float:
        """About the greatest speed [m/s] that it gives to matter, for the choice of substeps (host).

        Args:
            particles: now.
            time: since the start of the rollout [s].
            duration: from then on [s].
            reach: how far matter can get [m].
        """
        acting = float(self.acting(duration, time))
        if acting <= 0:
            return 0.0
        rates = _finite_norms(
            self._share(particles) * self.acceleration_of(particles.x, particles.v, self.elapsed + time)
        )
        most = float(np.max(rates, initial=0.0))
        return min(most * acting, math.sqrt(2 * most * reach))

    def touches(self, x: Float[Array, "p 3"], time: float, duration: float) -> Bool[np.ndarray, "p"]:
        """Which particles it acts on from a time [s] for a duration [s], if they stay where they are (host)."""
        touched = np.full(len(x), float(self.acting(duration, time)) > 0)
        if self.weights is not None:
            touched &= np.asarray(self.weights) > 0
        return touched if self.region is None else touched & np.asarray(self.region.contains(x))

    def _share(self, particles: Particles) -> Float[Array, "p 1"]:
        """Weight of each particle where it is, 0 where it is not finite."""
        alive = jnp.isfinite(particles.x).all(-1)
        share = jnp.where(alive, 1.0 if self.weights is None else self.weights, 0.0)
        share = share if self.region is None else jnp.where(self.region.contains(particles.x), share, 0.0)
        return share[:, None].astype(particles.x.dtype)


class Wind(Force):
    """Wind that drags matter along: an acceleration of (k + q |u − v|) (u − v) for a wind u and matter of velocity v.

    Under gravity g it carries matter to the terminal velocity u + g / k (with q = 0). It acts inside of matter as on
    its surface, as on leaves, grass and hair; give `weights` to shelter an inside. The drag is taken implicitly, so
    that no strength of it needs smaller steps. Gusts are four divergence-free waves of random directions, from
    `gust_size` on down, that travel with the wind and turn over by themselves.

    `Wind(velocity=(3.0, 0.0, 0.0), drag=2.0, gusts=1.0, gust_size=0.5)`

    `weights`, `region`, `start`, `end` and `elapsed` are those of `Force`.

    Attributes:
        velocity: of the wind [m/s].
        drag: k [1/s]: still matter gets the speed of the wind in about 1/k; for a thin leaf of 0.1 kg/m², 1 to 10.
        quadratic_drag: q [1/m], ½ c ρ A / m of a body; None, the default: 0.
        gusts: root mean square of the gusts' speed [m/s]; None, the default: a steady wind.
        gust_size: length of the longest wave of the gusts [m]; the default, 1, is a room's.
        seed: of the gusts.

    Raises:
        InputError: as `Force`.
    """

    velocity: Float[Array, "3"] = _number(Limits(-1e6, 1e6, unit="m/s"))
    drag: Scalar = _number(Limits(0, 1e9, unit="1/s"))
    quadratic_drag: Scalar | None = _number(Limits(0, 1e9, unit="1/m"), default=None)
    gusts: Scalar | None = _number(Limits(0, 1e6, unit="m/s"), default=None)
    gust_size: Scalar = _number(Limits(0, 1e9, above=True, unit="m"), default=1.0)
    seed: int = static_field(default=0)

    def wind(self, x: Points, time: Time) -> Points:
        """Velocity of the wind [m/s] at points [m] and a time [s] since `elapsed` was 0."""
        if self.gusts is None:
            return jnp.broadcast_to(self.velocity, x.shape)
        number, along, across, phases = _waves(self.seed)
        carried, velocity = x - self.velocity * time, self.velocity
        for k in range(_WAVES):
            wave = (2 * math.pi / self.gust_size * number[k]).astype(x.dtype)
            phase = wave * ((carried * along[k].astype(x.dtype)).sum(-1, keepdims=True) - self.gusts * time)
            velocity = velocity + self.gusts * jnp.cos(phase + phases[k]) * across[k].astype(x.dtype)
        return velocity

    def acceleration_of(self, x: Points, v: Points, time: Time) -> Points:
        """Of matter at points [m] with velocities [m/s]."""
        ahead = self.wind(x, time) - v
        return self._rate(ahead) * ahead

    def change(self, matter: Matter, totals: Any, dt: Time, time: Time) -> Points:
        """Backward Euler in the drag; |u − v| is that of the beginning."""
        ahead = self.wind(matter.x, self.elapsed + time) - matter.v
        share = self.acting(dt, time) * matter.weight * self._rate(ahead)
        return share / (1 + share) * ahead

    def speed_gain(self, particles: Particles, time: float, duration: float, reach: float) -> float:
        """The wind's own greatest speed."""
        if float(self.acting(duration, time)) <= 0:
            return 0.0
        gusts = (
            0.0 if self.gusts is None else float(self.gusts) * float(np.linalg.norm(_waves(self.seed)[2], axis=1).sum())
        )
        return float(np.linalg.norm(np.asarray(self.velocity))) + gusts

    def _rate(self, ahead: Points) -> Float[Array, "*n 1"] | Scalar:
        """Rate [1/s] at which matter takes the wind's velocity."""
        if self.quadratic_drag is None:
            return self.drag
        return self.drag + self.quadratic_drag * safe_norm(ahead)[..., None]


class ForceField(Force):
    """Acceleration that is uniform or linear in space, as of gravity in a region: a + G (x − c).

    With G = −ω² I it draws matter to c, where it swings with the angular frequency ω; an antisymmetric G turns it.

    `ForceField((0.0, 0.0, 12.0), region=BoxRegion(lower=(0, 0, 0), upper=(1, 1, 1)), start=0.5, end=1.0)`

    `weights`, `region`, `start`, `end` and `elapsed` are those of `Force`.

    Attributes:
        acceleration: a [m/s²].
        gradient: G, by row the derivatives of one component [1/s²]; None, the default: a uniform field.
        centre: c [m]; the default is the world's origin.

    Raises:
        InputError: as `Force`.
    """

    acceleration: Float[Array, "3"] = _number(Limits(-1e9, 1e9, unit="m/s²"))
    gradient: Float[Array, "3 3"] | None = _number(Limits(-1e9, 1e9, unit="1/s²"), default=None)
    centre: Float[Array, "3"] | None = _number(Limits(-1e9, 1e9, unit="m"), default=None)

    def acceleration_of(self, x: Points, v: Points, time: Time) -> Points:
        """Of matter at points [m]."""
        if self.gradient is None:
            return jnp.broadcast_to(self.acceleration, x.shape)
        offset = x if self.centre is None else x - self.centre
        return self.acceleration + (offset[..., None, :] * self.gradient).sum(-1)


class Impulse(Force):
    """A blow: momentum that matter receives in all, spread over `start` to `end` and over matter by weight and mass.

    All matter that it acts on changes its velocity by momentum / mass. A blow shorter than a step takes one step.

    `Impulse((0.0, 0.3, 0.0), region=SphereRegion(centre=(0, 0, 0.1), radius=0.03), start=0.5)`

    `weights`, `region` and `elapsed` are those of `Force`.

    Attributes:
        momentum: [N s].
        start: when it begins [s]; None, the default: at the start of the rollout.
        end: when it ends [s]; None, the default: after one step.

    Raises:
        InputError: as `Force`.
    """

    momentum: Float[Array, "3"] = _number(Limits(-1e9, 1e9, unit="N s"))

    def totals(self, matter: Matter) -> Any:
        """Mass that it acts on [kg]."""
        return (matter.weight * matter.mass).sum()

    def acting(self, dt: Time, time: Time) -> Time:
        """As `Force.acting`, of a blow that takes at least `dt`."""
        start, now = self._start, self.elapsed + time
        end = start + self._length(dt)
        return jnp.maximum(jnp.clip(now + dt - start, 0.0, dt) + jnp.clip(end - now, 0.0, dt) - dt, 0.0)

    def change(self, matter: Matter, totals: Any, dt: Time, time: Time) -> Points:
        """Share of the momentum, by mass."""
        length = self._length(dt)
        share = self.acting(dt, time) / jnp.where(length > 0, length, 1.0)
        return matter.weight * (self.momentum * jnp.where(totals > 0, share / jnp.where(totals > 0, totals, 1.0), 0.0))

    def speed_gain(self, particles: Particles, time: float, duration: float, reach: float) -> float:
        """The speed that the whole momentum gives to the matter that it acts on now."""
        share = np.asarray(self._share(particles), float)
        mass = float((share[:, 0] * np.where(share[:, 0] > 0, np.asarray(particles.mass, float), 0.0)).sum())
        if float(self.acting(duration, time)) <= 0 or mass <= 0:
            return 0.0
        return float(np.linalg.norm(np.asarray(self.momentum))) * float(share.max()) / mass

    @property
    def _start(self) -> Scalar | float:
        return 0.0 if self.start is None else self.start

    def _length(self, dt: Time) -> Time:
        return dt if self.end is None else jnp.maximum(self.end - self._start, dt)


class Spring(Force):
    """A spring and damper between the weighted middle of particles and a point, which may move: a hand that drags.

    The force k (T − X) + c (U − V) acts at the middle X = Σ w x / Σ w, of velocity V, towards the target T of velocity
    U, and is shared among the particles by weight. It is taken implicitly, so that a stiff spring needs no smaller
    steps; steps much shorter than its period √(m / k) lose no energy to speak of. Matter is picked by `weights`;
    `grab` makes them around a point. A `region` would let go of matter that leaves it.

    `Spring((0.2, 0.0, 0.5), stiffness=40.0, damping=2.0, weights=weights)`

    `weights`, `region`, `start`, `end` and `elapsed` are those of `Force`.

    Attributes:
        target: T at time 0 [m].
        stiffness: k [N/m].
        damping: c [N s/m]; the default is none.
        velocity: U [m/s]; None, the default: the target is still.

    Raises:
        InputError: as `Force`.
    """

    target: Float[Array, "3"] = _number(Limits(-1e9, 1e9, unit="m"))
    stiffness: Scalar = _number(Limits(0, 1e12, unit="N/m"))
    damping: Scalar = _number(Limits(0, 1e12, unit="N s/m"), default=0.0)
    velocity: Float[Array, "3"] | None = _number(Limits(-1e6, 1e6, unit="m/s"), default=None)

    def totals(self, matter: Matter) -> Any:
        """Weight, first moment [m], momentum per mass [m/s] and squared weight per mass [1/kg]."""
        weight = matter.weight
        light = jnp.where(matter.mass > 0, weight**2 / jnp.where(matter.mass > 0, matter.mass, 1.0), 0.0)
        rows = tuple(range(weight.ndim - 1))
        return weight.sum(), (weight * matter.x).sum(rows), (weight * matter.v).sum(rows), light.sum()

    def change(self, matter: Matter, totals: Any, dt: Time, time: Time) -> Points:
        """Backward Euler in the middle's motion, with the mass that the middle alone would have."""
        impulse = self._impulse(totals, dt, time)
        heavy = matter.mass > 0
        return jnp.where(heavy, matter.weight / jnp.where(heavy, matter.mass, 1.0), 0.0) * impulse

    def speed_gain(self, particles: Particles, time: float, duration: float, reach: float) -> float:
        """The speed with which the spring, as stretched as now, would let the picked particles pass its target."""
        if float(self.acting(duration, time)) <= 0:
            return 0.0
        matter = Matter(particles.x, particles.v, particles.mass[:, None], self._share(particles))
        matter = jax.tree.map(lambda rows: jnp.where(jnp.isfinite(particles.x).all(-1)[:, None], rows, 0.0), matter)
        weight, place, _, light = (np.asarray(total, float) for total in self.totals(matter))
        if weight <= 0:
            return 0.0
        target, own = self._target(time)
        stretched = float(np.linalg.norm(np.asarray(target) - place / weight))
        pace = float(np.linalg.norm(np.asarray(own)))
        return pace + (stretched + pace * duration) * math.sqrt(float(self.stiffness) * float(light)) / float(weight)

    def _impulse(self, totals: Any, dt: Time, time: Time) -> Float[Array, "3"]:
        """Momentum of the step for a unit of weight [N s]."""
        weight, place, speed, light = totals
        some = weight > 0
        over = 1 / jnp.where(some, weight, 1.0)
        target, own = self._target(time + dt)
        dt = self.acting(dt, time)
        stretched = target - over * (place + dt * speed)
        free = dt * (self.stiffness * stretched + self.damping * (own - over * speed))
        held = 1 + dt * over**2 * light * (self.damping + dt * self.stiffness)
        return jnp.where(some, over / held, 0.0) * free

    def _target(self, time: Time) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """Place [m] and velocity [m/s] of the target."""
        if self.velocity is None:
            return self.target, jnp.zeros_like(self.target)
        return self.target + self.velocity * (self.elapsed + time), self.velocity


@checked
def grab(
    particles: Particles,
    point: Vector,
    *,
    radius: float,
    frequency: float = 2.0,
    damping_ratio: float = 1.0,
    target: Vector | None = None,
) -> Spring:
    """A spring that holds the matter around a point, as a hand does: the drag of the viewer. Host.

    It takes the body (`Particles.body`) of the nearest particle, and weights that fall smoothly to 0 at the radius. It
    is as stiff as swings the whole body with the given frequency. To drag, replace the spring's `target` from frame to
    frame: arrays of the same shape, so that nothing is compiled again.

    `spring = grab(particles, (0.1, 0.0, 0.4), radius=0.05)`

    Args:
        particles: as they are now.
        point: [m].
        radius: of the hand [m]; without a particle so near, the nearest one is taken alone.
        frequency: of the whole body on the spring [Hz]; the default, 2, follows a hand in half a second.
        damping_ratio: 1, the default, ends the swinging fastest.
        target: where to hold it [m]; None, the default: where it is.

    Raises:
        InputError: no particle is finite, or a number is not > 0.
    """
    for name, value in (("radius", radius), ("frequency", frequency), ("damping_ratio", damping_ratio)):
        if not 0 < value < 1e9:
            raise InputError(f"grab: {name} = {value}: it must be > 0.")
    x, mass, body = (np.asarray(a) for a in (particles.x, particles.mass, particles.body))
    alive = np.isfinite(x).all(1)
    if not alive.any():
        raise InputError("grab: no particle is finite, so that there is nothing to hold.")
    distance = np.where(alive, np.linalg.norm(x - np.asarray(point, x.dtype), axis=1), np.inf)
    nearest = int(np.argmin(distance))
    own = alive & (body == body[nearest])
    weights = np.where(own, np.clip(1 - (distance / radius) ** 2, 0, None) ** 2, 0.0)
    if not weights.any():
        weights[nearest] = 1.0
    middle = (weights[own, None] * x[own]).sum(0) / weights[own].sum()
    whole, rate = float(mass[own].sum()), 2 * math.pi * frequency
    dtype = particles.x.dtype
    return Spring(
        target=jnp.asarray(middle if target is None else target, dtype),
        stiffness=jnp.asarray(whole * rate**2, dtype),
        damping=jnp.asarray(2 * damping_ratio * whole * rate, dtype),
        weights=jnp.asarray(weights, dtype),
    )


def columns_of(forces: tuple[Force, ...]) -> tuple[int | None, ...]:
    """Row of `State.weights` that each force reads; None: it weights all alike. Static."""
    found: list[int | None] = []
    for force in forces:
        found.append(None if force.weights is None else sum(column is not None for column in found))
    return tuple(found)


def weights_of(forces: tuple[Force, ...]) -> Float[Array, "p k"] | None:
    """Weights of the particles by the forces that have any, for `group_by_law`; None where none has."""
    own = [force.weights for force in forces if force.weights is not None]
    return jnp.stack(own, -1) if own else None


def without_weights(forces: tuple[Force, ...]) -> tuple[Force, ...]:
    """The forces without their weights, which the particles carry."""
    return tuple(force if force.weights is None else eqx.tree_at(lambda f: f.weights, force, None) for force in forces)


def of_some(forces: tuple[Force, ...], index: Any) -> tuple[Force, ...]:
    """The forces on some of the particles."""
    return tuple(
        force if force.weights is None else eqx.tree_at(lambda f: f.weights, force, force.weights[index])
        for force in forces
    )


def check_forces(forces: tuple[Force, ...], count: int) -> None:
    """Raise an InputError for weights that are not one for each of `count` particles."""
    for force in forces:
        if force.weights is not None and force.weights.shape != (count,):
            raise InputError(
                f"{type(force).__name__}.weights has shape {force.weights.shape}: give one weight for each of the"
                f" {count} particles."
            )


def _waves(
    seed: int,
) -> tuple[Float[np.ndarray, "k"], Float[np.ndarray, "k 3"], Float[np.ndarray, "k 3"], Float[np.ndarray, "k"]]:
    """Wave numbers relative to the longest wave's, unit directions, velocities across them and phases of gusts.

    The energy of a wave falls with its number to the power 2/3 (Kolmogorov); the mean square of their sum is 1.
    """
    random = np.random.default_rng(seed)
    number = 1.7 ** np.arange(_WAVES)
    along, other = random.normal(size=(2, _WAVES, 3))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.cross(along, other)
    across *= (number ** (-1 / 3) / np.linalg.norm(across, axis=1))[:, None]
    across *= math.sqrt(2 / (across**2).sum())
    return number, along, across, random.uniform(0, 2 * math.pi, _WAVES)


def _finite_norms(vectors: Any) -> Float[np.ndarray, "p"]:
    lengths = np.linalg.norm(np.asarray(vectors, float), axis=-1)
    return lengths[np.isfinite(lengths)]
