"""Real captures: every setting that is compared makes a valid reconstruction at the sizes of use."""

import numpy as np
import pytest

from benchmarks import real
from pigjax import Views
from pigjax.core.camera import orbit


@pytest.mark.parametrize("switch", real.SWITCHES)
@pytest.mark.parametrize(("steps", "splats"), [(3000, None), (5, 4)])
def test_a_setting_is_one_of_the_trainer_and_growth_reaches_its_end(switch, steps, splats):
    cameras = orbit((0.0, 0.0, 0.0), radius=1.0, elevation=0.3, frames=3, focal=30.0, width=8, height=8)
    views = Views(cameras, ("a", "b", "c"), np.zeros((3, 8, 8, 3)), None, ("train",) * 3)
    config = real._config(steps, splats, switch, views)
    assert config.splats == (splats or 1000)
    assert (config == real._config(steps, splats, "none", views)) == (switch in ("none", "no-shell"))
