"""The default camera of a scene with photos: the view that shows the moving objects best, cropped to them."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from pigjax.core.camera import Camera, project
from pigjax.core.views import Views

_SHARE = 0.5  # of the picture's width or height that moving objects span at most: the rest is room for their motion
_ENDS = (0.01, 0.99)  # quantiles of the matter's positions that the picture frames


def framing_camera(views: Views, matter: Float[np.ndarray, "p 3"], width: int, height: int) -> Camera | None:
    """Camera of a training view, cropped to matter with room for its motion; None where no view shows all of it.

    Among the views that hold the whole box of the matter it is the one in which that is largest. The crop stays within
    the photo, since nobody saw what lies beyond.

    Args:
        views: posed photos.
        matter: positions of the moving objects [m].
        width: of the pictures [px].
        height: of the pictures [px].
    """
    low, high = np.quantile(np.asarray(matter, np.float64), _ENDS, axis=0)
    corners = np.array(np.meshgrid(*zip(low, high))).reshape(3, -1).T
    cameras = views.training.cameras
    size = np.array([cameras.width, cameras.height], float)
    best, largest = None, 0.0
    for index in range(len(cameras)):
        camera = cameras[index]
        found, depth = project(jnp.asarray(corners, camera.focal.dtype), camera)
        points, z = np.asarray(found, np.float64), np.asarray(depth)
        if (z > 0).all() and (points >= 0).all() and (points <= size).all():
            area = float(np.prod(np.ptp(points, axis=0) / size))
            if area > largest:
                best, largest = (camera, points), area
    if best is None:
        return None
    camera, points = best
    picture = np.array([width, height], float)
    zoom = float(np.min(_SHARE * picture / np.maximum(np.ptp(points, axis=0), 1e-6)))
    zoom = max(zoom, float(np.max(picture / size)))  # pixels of the picture for one of the photo
    half = picture / (2 * zoom)
    middle = np.clip((points.min(0) + points.max(0)) / 2, half, np.maximum(size - half, half))
    dtype = camera.focal.dtype
    centre = (np.asarray(camera.centre, np.float64) - middle) * zoom + picture / 2
    focal = np.asarray(camera.focal, np.float64) * zoom
    return Camera(camera.world_to_cam, jnp.asarray(focal, dtype), jnp.asarray(centre, dtype), width, height)
