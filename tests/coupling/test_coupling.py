import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from shapes import box, make_gaussians, sphere

from pigjax.clamp import ClampParams
from pigjax.core.errors import InputError
from pigjax.coupling.binding import at_frame, bind, deform
from pigjax.coupling.seeding import seed_particles
from pigjax.mpm import Trajectory
from pigjax.mpm.materials import preset
from pigjax.splatting.types import as_splats

BALL, CUBE, BACKGROUND = 1, 7, 40
RADIUS, SIDE = 0.1, 0.16
MATERIALS = {CUBE: preset("rubber"), BALL: preset("jelly")}
SPACING = 0.02


def scene():
    """A ball, a box on its own, and still Gaussians around them; their order is mixed."""
    rng = np.random.default_rng(0)
    means = [
        sphere(1_500, RADIUS) + np.array([0.5, 0.2, 0.4]),
        box(2_500, (SIDE,) * 3, without_bottom=True) + np.array([-0.3, 0, 0.1]),
        rng.uniform(-1, 1, (BACKGROUND, 3)),
    ]
    labels = np.repeat([BALL, CUBE, 0], [1_500, 2_500, BACKGROUND])
    order = rng.permutation(len(labels))
    gaussians = make_gaussians(np.concatenate(means)[order], scales=(4e-3, 3e-3, 1e-3))
    quats = jnp.asarray(rng.normal(size=(len(labels), 4)), float)
    return eqx.tree_at(lambda g: g.quats, gaussians, quats), labels[order]


@pytest.fixture(scope="module")
def seeded():
    gaussians, labels = scene()
    particles, table = seed_particles(gaussians, labels, MATERIALS, spacing=SPACING, velocities={BALL: (0, 0, -2.0)})
    return gaussians, labels, particles, table


@eqx.filter_jit
def draw(gaussians, particles, binding=None, mode="aligned"):
    return deform(gaussians, particles, ClampParams(), mode=mode, binding=binding)


def test_mass_is_density_times_the_volume_of_the_object(seeded):
    _, _, particles, table = seeded
    for row, volume in [(0, SIDE**3), (1, 4 / 3 * np.pi * RADIUS**3)]:
        mine = np.asarray(particles.material) == row
        assert np.asarray(particles.volume0, np.float64)[mine].sum() == pytest.approx(volume, rel=0.03)
        mass = np.asarray(particles.mass, np.float64)[mine].sum()
        assert mass == pytest.approx(float(table.density[row] * particles.volume0[mine].sum()), rel=1e-5)
    assert float(particles.volume0.min()) > 0


def test_the_sum_of_volumes_does_not_depend_on_spacing_or_on_gaussians_per_cell(seeded):
    gaussians, labels, particles, _ = seeded
    total = np.asarray(particles.volume0, np.float64).sum()
    for options in ({"spacing": 0.05}, {"spacing": SPACING, "gaussians_per_cell": 1}, {}):
        other, _ = seed_particles(gaussians, labels, MATERIALS, **options)
        # 0.2 %: a Gaussian just outside all lattice cells that touch the solid adds its own small ellipsoid
        assert np.asarray(other.volume0, np.float64).sum() == pytest.approx(total, rel=2e-3)


def test_centre_of_mass_is_that_of_the_object(seeded):
    _, _, particles, _ = seeded
    mine = np.asarray(particles.material) == 1
    centre = np.average(np.asarray(particles.x)[mine], axis=0, weights=np.asarray(particles.mass)[mine])
    np.testing.assert_allclose(centre, [0.5, 0.2, 0.4], atol=0.02 * RADIUS)


def test_each_gaussian_of_an_object_is_one_particle_at_its_centre(seeded):
    gaussians, labels, particles, _ = seeded
    carried = np.asarray(particles.gaussian)
    own = carried >= 0
    np.testing.assert_array_equal(np.sort(carried[own]), np.flatnonzero(labels > 0))
    np.testing.assert_array_equal(np.asarray(particles.x)[own], np.asarray(gaussians.means)[carried[own]])
    rows = {CUBE: 0, BALL: 1}
    np.testing.assert_array_equal(np.asarray(particles.material)[own], [rows[i] for i in labels[carried[own]]])
    speed = np.asarray(particles.v)
    assert (speed[np.asarray(particles.material) == 1] == [0, 0, -2.0]).all()
    assert (speed[np.asarray(particles.material) == 0] == 0).all()


def test_the_inside_is_filled_and_the_surface_alone_on_request(seeded):
    gaussians, labels, particles, _ = seeded
    step = SPACING / 2
    inner = np.asarray(particles.x)[(np.asarray(particles.gaussian) < 0) & (np.asarray(particles.material) == 1)]
    distance = np.linalg.norm(inner - [0.5, 0.2, 0.4], axis=1)
    assert distance.max() < 1.01 * RADIUS
    # all lattice cells but those at the surface
    core = distance < RADIUS - 2 * step
    assert core.sum() * step**3 == pytest.approx(4 / 3 * np.pi * (RADIUS - 2 * step) ** 3, rel=0.05)
    hollow, _ = seed_particles(gaussians, labels, MATERIALS, spacing=SPACING, fill=False)
    assert (np.asarray(hollow.gaussian) >= 0).all()
    assert float(hollow.volume0.sum()) < 0.7 * float(particles.volume0.sum())


def test_at_rest_the_drawing_is_the_scene(seeded):
    gaussians, _, particles, _ = seeded
    splats, rest = draw(gaussians, particles), as_splats(gaussians)
    np.testing.assert_array_equal(splats.means, rest.means)
    np.testing.assert_allclose(splats.factors, rest.factors, atol=4e-3 * 3e-6)  # float32 of the largest scale
    np.testing.assert_array_equal(splats.opacities, rest.opacities)
    np.testing.assert_array_equal(splats.sh, rest.sh)


def rotation_matrix(angle=0.7):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.array([[1, 0, 0], [0, c, s], [0, -s, c]])


def moved(particles, matrix, shift):
    """Particles under an affine motion; matter that is not drawn yet has F = 1."""
    dtype = particles.x.dtype
    F = jnp.broadcast_to(jnp.asarray(matrix, dtype), particles.F.shape)
    x = jnp.asarray(np.asarray(particles.x) @ matrix.T + shift, dtype)
    return eqx.tree_at(lambda p: (p.x, p.F_visual), particles, (x, F))


def test_rigid_motion_of_the_particles_moves_gaussians_rigidly_and_no_others(seeded):
    gaussians, labels, particles, _ = seeded
    rotation, shift = rotation_matrix(), np.array([0.3, -0.2, 1.0])
    splats, rest = draw(gaussians, moved(particles, rotation, shift)), draw(gaussians, particles)
    own = labels > 0
    np.testing.assert_allclose(splats.means[own], np.asarray(rest.means)[own] @ rotation.T + shift, atol=1e-6)
    factors = rotation @ np.asarray(rest.factors)
    covariance, expected = (np.einsum("nij,nkj->nik", f, f) for f in (splats.factors, factors))
    np.testing.assert_allclose(covariance[own], expected[own], atol=1e-5 * 4e-3**2)
    for moving, still in zip(jax.tree.leaves(splats), jax.tree.leaves(rest)):
        np.testing.assert_array_equal(moving[~own], still[~own])


def test_affine_motion_carries_means_and_covariances_exactly(seeded):
    gaussians, labels, particles, _ = seeded
    matrix, own = np.array([[1.2, 0.3, 0], [0, 0.9, -0.1], [0.2, 0, 1.1]]), labels > 0
    splats = draw(gaussians, moved(particles, matrix, 0.0), mode="covariance")
    np.testing.assert_allclose(splats.means[own], np.asarray(gaussians.means)[own] @ matrix.T, atol=1e-6)
    factors = matrix @ np.asarray(as_splats(gaussians).factors)
    covariance, expected = (np.einsum("nij,nkj->nik", f, f) for f in (splats.factors, factors))
    np.testing.assert_allclose(covariance[own], expected[own], atol=1e-5 * 4e-3**2)


def test_gaussians_without_a_particle_follow_affine_motion_exactly():
    gaussians, labels = scene()
    floater = int(np.flatnonzero(labels == BALL)[0])
    gaussians = eqx.tree_at(lambda g: g.means, gaussians, gaussians.means.at[floater].set(jnp.array([0.5, 0.2, 0.8])))
    particles, _ = seed_particles(gaussians, labels, MATERIALS, spacing=SPACING, gaussians_per_cell=1)
    binding = bind(gaussians, labels, particles)
    carried = np.asarray(particles.gaussian)
    assert floater in binding.gaussian
    assert floater not in carried
    np.testing.assert_array_equal(
        np.sort(np.concatenate([carried[carried >= 0], binding.gaussian])), np.flatnonzero(labels > 0)
    )
    np.testing.assert_allclose(binding.weights.sum(1), 1, rtol=1e-6)
    carriers = labels[carried[np.asarray(binding.particles)]]
    assert (carriers == labels[np.asarray(binding.gaussian)][:, None]).all()

    rotation, shift = rotation_matrix(), np.array([0.3, -0.2, 1.0])
    splats = draw(gaussians, moved(particles, rotation, shift), binding)
    expected = np.asarray(gaussians.means) @ rotation.T + shift
    np.testing.assert_allclose(splats.means[labels > 0], expected[labels > 0], atol=1e-6)
    np.testing.assert_array_equal(splats.means[labels == 0], gaussians.means[labels == 0])
    # one Gaussian in each cell at most
    step = SPACING / 2
    assert len(carried[carried >= 0]) < (4 * np.pi * RADIUS**2 + 5 * SIDE**2) / step**2 * 2.5
    assert float(particles.volume0.min()) > 0.04 * step**3


def test_gradients_of_the_drawing_to_positions_and_deformation(x64):
    gaussians, labels = scene()
    keep = np.concatenate([np.flatnonzero(labels == BALL)[:40], np.flatnonzero(labels == 0)[:5]])
    gaussians, labels = jax.tree.map(lambda a: a[keep].astype(float), gaussians), labels[keep]
    particles, _ = seed_particles(
        gaussians, labels, {BALL: preset("jelly")}, spacing=0.16, fill=False, gaussians_per_cell=1
    )
    binding = bind(gaussians, labels, particles)
    assert 0 < len(binding) < 40
    rng = np.random.default_rng(1)
    state = (particles.x, particles.F_visual + 0.3 * rng.normal(size=particles.F.shape))
    keys = [jnp.asarray(rng.normal(size=leaf.shape)) for leaf in jax.tree.leaves(as_splats(gaussians))]

    @jax.jit
    @jax.value_and_grad
    def loss(state):
        posed = eqx.tree_at(lambda p: (p.x, p.F_visual), particles, state)
        # this mode is polynomial: the clamp's own derivatives are tested with the clamp
        splats = deform(gaussians, posed, ClampParams(), mode="covariance", binding=binding)
        return sum(jnp.vdot(key, leaf) for key, leaf in zip(keys, jax.tree.leaves(splats)))

    _, gradient = loss(state)
    for argument in (0, 1):
        direction = [jnp.zeros_like(part) for part in state]
        direction[argument] = jnp.asarray(rng.normal(size=state[argument].shape))
        ahead, behind = (
            loss(tuple(part + sign * 1e-5 * step for part, step in zip(state, direction)))[0] for sign in (1, -1)
        )
        exact = sum(jnp.vdot(part, step) for part, step in zip(gradient, direction))
        assert float(exact) == pytest.approx(float((ahead - behind) / 2e-5), rel=1e-8)


def test_frames_of_a_trajectory_are_drawn_together(seeded):
    gaussians, _, particles, _ = seeded
    shifts = jnp.asarray([[0.0, 0, 0], [0.1, 0, 0], [0, 0, -0.3]])
    turned = jnp.stack([jnp.asarray(rotation_matrix(angle), float) for angle in (0.0, 0.5, 1.0)])
    trajectory = Trajectory(
        x=particles.x + shifts[:, None],
        v=jnp.zeros((3, *particles.x.shape)),
        F_visual=jnp.broadcast_to(turned[:, None], (3, *particles.F.shape)),
    )
    together = jax.vmap(lambda frame: draw(gaussians, at_frame(particles, trajectory, frame), mode="covariance"))(
        jnp.arange(3)
    )
    for frame in range(3):
        alone = draw(gaussians, at_frame(particles, trajectory, frame), mode="covariance")
        np.testing.assert_allclose(together.means[frame], alone.means, atol=1e-7)
        np.testing.assert_allclose(together.factors[frame], alone.factors, atol=1e-8)


def test_an_object_within_another_takes_its_place():
    means = np.concatenate([sphere(3_000, 0.2), sphere(1_000, 0.1)])
    labels = np.repeat([1, 2], [3_000, 1_000])
    particles, _ = seed_particles(make_gaussians(means), labels, {1: preset("jelly"), 2: preset("metal")}, spacing=0.02)
    volumes = [float(particles.volume0[np.asarray(particles.material) == row].sum()) for row in (0, 1)]
    small, large = 4 / 3 * np.pi * np.array([0.1, 0.2]) ** 3
    assert volumes == pytest.approx([large - small, small], rel=0.03)
    outer = np.asarray(particles.x)[(np.asarray(particles.material) == 0) & (np.asarray(particles.gaussian) < 0)]
    assert np.linalg.norm(outer, axis=1).min() > 0.09


def test_sheets_and_single_gaussians_weigh_what_their_ellipsoids_hold():
    rng = np.random.default_rng(0)
    sheet = np.insert(rng.random((2_000, 2)), 2, 0.0, 1)
    means = np.concatenate([sheet, [[5.0, 5, 5]]])
    particles, _ = seed_particles(
        make_gaussians(means, scales=(0.02, 0.02, 2e-3)),
        np.repeat([1, 2], [2_000, 1]),
        {1: preset("rubber"), 2: preset("jelly")},
        spacing=0.1,
    )
    assert len(particles) >= 2_001
    grain = 4 / 3 * np.pi * 1.5**3 * 0.02 * 0.02 * 2e-3
    assert float(particles.volume0[-1]) == pytest.approx(grain, rel=1e-4)
    assert np.isfinite(particles.volume0).all()


def test_bad_input_is_named(seeded):
    gaussians, labels, _, _ = seeded
    jelly = preset("jelly")
    twice = jax.tree.map(lambda a: jnp.concatenate([a, a]), gaussians)
    cases = [
        (gaussians, labels, {}, {}, "materials is empty"),
        (gaussians, labels, {0: jelly}, {}, "object 0.*background"),
        (gaussians, labels, {3: jelly}, {}, r"object 3.*no Gaussians.*\[1, 7\]"),
        (gaussians, labels, {BALL: jelly}, {"velocities": {CUBE: (0, 0, 0)}}, "velocities has object 7"),
        (gaussians, labels[:-1], {BALL: jelly}, {}, "labels has shape"),
        (gaussians, labels, {BALL: jelly}, {"spacing": 5.0}, "object 1.*refine"),
        (gaussians, labels, {BALL: jelly}, {"spacing": 1e-4}, "object 1.*coarsen"),
        (gaussians, labels, {BALL: jelly}, {"spacing": -1.0}, "spacing = -1"),
        (twice, np.concatenate([labels, labels * 2]), {BALL: jelly, 2 * BALL: jelly}, {}, "objects 1 and 2"),
    ]
    for scene_, ids, materials, options, message in cases:
        with pytest.raises(InputError, match=message):
            seed_particles(scene_, ids, materials, **options)


def test_only_what_moves_is_written(seeded):
    """Colours and opacities are those of the scene, untouched, and so is every row of a Gaussian at rest."""
    gaussians, _, particles, _ = seeded
    gaussians = eqx.tree_at(lambda g: g.sh, gaussians, jnp.zeros((len(gaussians), 4, 3)).at[:, 2].set(0.3))
    moved = eqx.tree_at(lambda p: (p.x, p.F_visual), particles, (particles.x + 0.1, 1.1 * particles.F_visual))
    posed, rest = deform(gaussians, moved, ClampParams()), as_splats(gaussians)
    assert posed.sh is gaussians.sh
    np.testing.assert_array_equal(posed.opacities, rest.opacities)
    still = np.setdiff1d(np.arange(len(gaussians)), np.asarray(particles.gaussian))
    assert len(still) >= BACKGROUND
    np.testing.assert_array_equal(posed.means[still], rest.means[still])
    np.testing.assert_array_equal(posed.factors[still], rest.factors[still])
    np.testing.assert_array_equal(posed.sh_rotations[still], np.broadcast_to(np.eye(3), (len(still), 3, 3)))
    assert (np.asarray(posed.means) != np.asarray(rest.means)).any(1).sum() == len(gaussians) - len(still)


def test_states_of_other_particles_are_refused(seeded):
    gaussians, _, particles, _ = seeded
    fewer = Trajectory(*(a[None, 5:] for a in (particles.x, particles.v, particles.F_visual)))
    with pytest.raises(InputError, match=rf"Particles\.v holds {len(particles)}|Particles\.F holds {len(particles)}"):
        at_frame(particles, fewer, 0)
    short = eqx.tree_at(lambda p: (p.x, p.F_visual), particles, (particles.x[5:], particles.F_visual[5:]))
    with pytest.raises(InputError, match=rf"Particles\.x holds {len(particles) - 5}"):
        deform(gaussians, short, ClampParams())
