"""Dense float64 compositor: every Gaussian at every pixel, in NumPy, with nothing shared with the tile renderer."""

import numpy as np


def sh_colour(sh, d):
    """Colour from the real spherical harmonics of scipy, in 3DGS' order (l, m from -l to l, Condon-Shortley phase)."""
    from scipy.special import sph_harm_y

    theta, phi = np.arccos(np.clip(d[:, 2], -1, 1)), np.arctan2(d[:, 1], d[:, 0])
    degree = int(np.sqrt(sh.shape[1])) - 1
    columns = []
    for band in range(degree + 1):
        for m in range(-band, band + 1):
            y = sph_harm_y(band, abs(m), theta, phi)
            # scipy's functions carry the phase (-1)^m already, and so do 3DGS' constants
            columns.append(y.real if m == 0 else np.sqrt(2) * (y.real if m > 0 else y.imag))
    return np.maximum(np.einsum("nk,nkc->nc", np.stack(columns, 1), sh) + 0.5, 0)


def dense_render(
    means, quats, scales, opacities, sh, view, focal, centre, width, height, *, config, tau=0.5, weights=None
):
    """rgb, alpha, mean depth, surface depth and object weights in float64."""
    means, quats, scales, opacities, sh, view = (
        np.asarray(v, np.float64) for v in (means, quats, scales, opacities, sh, view)
    )
    w, x, y, z = (quats / np.linalg.norm(quats, axis=1, keepdims=True)).T
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    ).transpose(2, 0, 1)
    covariance = np.einsum("nij,nj,nkj->nik", rotation, scales**2, rotation)
    local = means @ view[:3, :3].T + view[:3, 3]
    eye = -np.linalg.solve(view[:3, :3], view[:3, 3])
    d = means - eye
    colour = sh_colour(sh, d / np.linalg.norm(d, axis=1, keepdims=True))
    near = 0.01 * np.exp(np.log(np.linalg.norm(d, axis=1)).mean()) if config.near is None else config.near
    px, py = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    transmittance = np.ones((height, width))
    closed = np.zeros((height, width), bool)
    rgb, depth = np.zeros((height, width, 3)), np.zeros((height, width))
    surface = np.full((height, width), np.nan)
    objects = None if weights is None else np.zeros((height, width, weights.shape[1]))
    for i in np.argsort(local[:, 2], kind="stable"):
        t = local[i]
        if t[2] <= near:
            continue
        limit = [
            ((-centre[k] / focal[k] - 0.15 * s / focal[k]), ((s - centre[k]) / focal[k] + 0.15 * s / focal[k]))
            for k, s in enumerate((width, height))
        ]
        u, v = (np.clip(t[k] / t[2], *limit[k]) for k in range(2))
        jacobian = np.array([[focal[0] / t[2], 0, -focal[0] * u / t[2]], [0, focal[1] / t[2], -focal[1] * v / t[2]]])
        flat = jacobian @ view[:3, :3]
        bare = flat @ covariance[i] @ flat.T
        spread = bare + config.dilation * np.eye(2)
        opacity = opacities[i]
        if config.antialias:
            opacity *= np.sqrt(max(np.linalg.det(bare), 0) / np.linalg.det(spread))
        conic = np.linalg.inv(spread)
        dx = px - (focal[0] * t[0] / t[2] + centre[0])
        dy = py - (focal[1] * t[1] / t[2] + centre[1])
        power = 0.5 * (conic[0, 0] * dx * dx + conic[1, 1] * dy * dy) + conic[0, 1] * dx * dy
        alpha = np.minimum(config.alpha_max, opacity * np.exp(-power))
        alpha[(alpha < config.alpha_min) | closed] = 0
        behind = transmittance * (1 - alpha)
        crossing = (transmittance >= tau) & (behind < tau) & ~closed
        surface[crossing] = t[2]
        stop = (behind <= config.transmittance_min) & (alpha > 0)
        closed |= stop
        weight = np.where(stop, 0, alpha * transmittance)
        rgb += weight[..., None] * colour[i]
        depth += weight * t[2]
        if objects is not None:
            objects += weight[..., None] * weights[i]
        transmittance = np.where(stop, transmittance, behind)
    alpha = 1 - transmittance
    return rgb, alpha, np.where(alpha > 0, depth / np.where(alpha > 0, alpha, 1), 0), surface, objects
