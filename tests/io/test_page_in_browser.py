"""The page of an export in a browser without a network."""

import shutil

import jax.numpy as jnp
import numpy as np
import pytest

from pigjax import io
from pigjax.splat import Gaussians

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
FLAGS = ["--no-sandbox", "--use-gl=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="needs chromium")
def test_the_page_plays_offline_and_its_slider_changes_the_picture(tmp_path):
    """Two frames, red on the left and blue on the right."""
    pytest.importorskip("viser")
    playwright = pytest.importorskip("playwright.sync_api")

    def frame(x, colour):
        sh = (np.asarray([[colour]]) - 0.5) / 0.28209479177387814
        parts = [[x, 0.0, 0.0]], np.full((1, 3), np.log(0.3)), [[1.0, 0, 0, 0]], [8.0], sh
        return Gaussians(*(jnp.asarray(values, jnp.float32) for values in parts))

    frames = [frame(-1.0, [1.0, 0, 0]), frame(1.0, [0, 0, 1.0])]
    path = tmp_path / "a.html"
    io.save_page(path, frames, moving=np.array([True]), fps=0.5)
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        page = browser.new_context(viewport={"width": 400, "height": 420}, offline=True).new_page()
        asked, broken = [], []
        page.on("request", lambda request: asked.append(request.url))
        page.on("pageerror", lambda error: broken.append(str(error)))
        page.goto(path.as_uri(), timeout=120_000)
        page.wait_for_timeout(12_000)
        page.mouse.click(19, 402)  # pause
        seen = []
        for place in (92, 290):
            page.mouse.click(place, 402)
            page.wait_for_timeout(8_000)
            page.screenshot(path=tmp_path / "shot.png", timeout=120_000)
            seen.append(io.read_image(tmp_path / "shot.png")[140:380])  # below the notice on software rendering
        browser.close()
    assert broken == []
    assert all(url.startswith(("file:", "data:", "blob:")) for url in asked)
    red, blue = ([(p[..., k] - p[..., 2 - k]).max() for p in seen] for k in (0, 2))
    print(f"red {red}, blue {blue}")
    assert red[0] > 0.3 > red[1]
    assert blue[1] > 0.3 > blue[0]
