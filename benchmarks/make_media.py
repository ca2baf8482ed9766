"""Pictures of the README from a finished demo: `pigjax demo && python benchmarks/make_media.py pigjax-demo`."""

import sys
from pathlib import Path

import imageio.v3 as iio
import numpy as np
from PIL import Image

from pigjax import write_video

MEDIA = Path(__file__).parents[1] / "docs" / "media"

frames = iio.imread(Path(sys.argv[1]) / "video.mp4")
small = [np.asarray(Image.fromarray(frame).resize((360, 270))) for frame in frames]
MEDIA.mkdir(parents=True, exist_ok=True)
write_video(MEDIA / "tabletop.gif", small, fps=12)
