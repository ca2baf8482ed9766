"""Gaussians above a feature threshold are the matter: the method of Feature Splatting (Qiu et al., ECCV 2024).

Kept: features distilled into Gaussians, objects by a threshold on their cosine with a query, MPM on the Gaussians
chosen, which give their positions to what is drawn and keep their shapes. Left out: CLIP (features are perfect ones of
the masks, see `feature_distillation`) and the rotation that the paper estimates for its splats. The paper also fills
objects; the study runs it with the filling of ours and without any.
"""

import numpy as np


def ids_by_members(members: np.ndarray, similarity: np.ndarray) -> np.ndarray:
    """One id [n] for each Gaussian of members [n m]: where queries share it the more similar one, else 0."""
    claims = np.where(members, similarity, -np.inf)
    return np.where(members.any(1), np.argmax(claims, 1), 0)
