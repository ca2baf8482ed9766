"""The page of `pigjax view` in a headless browser; needs viser, playwright and a Chromium, else it is left out.

Run by name: `pytest -m slow tests/cli/test_viewer_page.py`. The browser is /usr/bin/chromium, or `PIGJAX_CHROMIUM`.
"""

import io as bytes_io
import os
import shutil
import socket
import time
import urllib.error
import urllib.request

import numpy as np
import pytest
import tomli_w
from PIL import Image
from scenes import THROW, ball

from pigjax import io
from pigjax.cli.viewer.opened import open_path
from pigjax.cli.viewer.page import Page
from pigjax.cli.viewer.server import start_server
from pigjax.cli.viewer.session import Session
from pigjax.scene import load_scene, run_scene

CHROMIUM = os.environ.get("PIGJAX_CHROMIUM") or shutil.which("chromium") or "/usr/bin/chromium"
pytest.importorskip("viser", reason="the page needs viser: pip install 'pigjax[view]'")
playwright = pytest.importorskip("playwright.sync_api", reason="the browser needs playwright: pip install playwright")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not os.path.exists(CHROMIUM), reason=f"there is no browser at {CHROMIUM}; set PIGJAX_CHROMIUM"),
]
ARGUMENTS = [
    *("--no-sandbox", "--disable-gpu", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    *("--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-component-update"),
    "--disable-sync",
]
# what the page of viser itself says: a quad of two coordinates, of which three.js wants a sphere, and a listener of
# the mouse that the browser makes passive
KNOWN = (
    "THREE.BufferGeometry.computeBoundingSphere(): Computed radius is NaN",
    "Unable to preventDefault inside passive event listener",
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene")
    io.save_ply(path / "cloud.ply", ball(1500))
    table = {**THROW, "simulation": {"dx": 0.08, "frames": 6, "fps": 30.0, "particles_per_cell": 4}}
    (path / "scene.toml").write_text(tomli_w.dumps(table))
    run_scene(load_scene(path / "scene.toml"), path / "run")
    return path


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as started:
        chromium = started.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        yield chromium
        chromium.close()


@pytest.fixture
def serve():
    pages = []

    def begin(path):
        page = Page(Session(open_path(path)), start_server(port=0))
        pages.append(page)
        return page, f"http://localhost:{page.server.get_port()}"

    yield begin
    for page in pages:
        page.close()


def visit(browser, address):
    """A client that shows the page, and the errors of its console."""
    client = browser.new_page(viewport={"width": 1000, "height": 420})
    client.set_default_timeout(120_000)
    errors = []
    client.on("console", lambda line: errors.append(line.text) if line.type == "error" else None)
    client.on("pageerror", lambda error: errors.append(str(error)))
    client.goto(address)
    client.get_by_role("button", name="play").wait_for()
    return client, errors


def picture(client):
    """The canvas left of the controls."""
    bytes_ = client.screenshot(clip={"x": 320, "y": 0, "width": 280, "height": 420})
    return np.asarray(Image.open(bytes_io.BytesIO(bytes_)).convert("RGB"), np.int16)


def until(client, holds, seconds=90.0):
    """Wait until something holds, with the browser at work."""
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end, "it does not come about"
        client.wait_for_timeout(250)


def splats_show(client):
    return lambda: (picture(client).std(axis=2) > 12).mean() > 0.01  # coloured pixels; grid and sky are grey


def unknown(errors):
    return [line for line in errors if not any(known in line for known in KNOWN)]


def changed(client, before):
    return lambda: (np.abs(picture(client) - before).max(axis=2) > 40).mean() > 0.002


def test_a_run_shows_its_frames_to_two_clients_and_the_server_stops(browser, serve, folder):
    page, address = serve(folder / "run")
    first, errors = visit(browser, address)
    second, more = visit(browser, address)
    until(first, splats_show(first))
    until(second, splats_show(second))
    begin, other = picture(first), picture(second)
    slider = first.get_by_role("slider").first
    slider.evaluate("thumb => thumb.focus()")
    first.keyboard.press("End")
    until(first, lambda: page.session.frame == 6)
    until(first, changed(first, begin))
    until(second, changed(second, other))
    posed = picture(first)
    page.session.change_look(lambda_S=-0.5, tau_max=8.0, lambda_R=2.5)
    page._do("push", page._push_moved)
    until(first, changed(first, posed))
    assert unknown(errors + more) == []

    with pytest.raises(urllib.error.HTTPError, match="404"):
        urllib.request.urlopen(f"{address}/..%2f..%2f..%2fetc/passwd")
    stranger = urllib.request.Request(address, headers={"Origin": "https://evil.example"})
    with pytest.raises(urllib.error.HTTPError, match="403"):
        urllib.request.urlopen(stranger)
    port = page.server.get_port()
    page.close()
    assert not page._thread.is_alive()
    with pytest.raises(OSError):
        socket.create_connection(("127.0.0.1", port), timeout=2).close()
    first.close()
    second.close()


def test_matter_is_simulated_and_follows_the_mouse(browser, serve, folder):
    page, address = serve(folder / "scene.toml")
    page.session.draft.set_velocity("ball", (0, 0, 0))
    page.session.draft.set_gravity((0, 0, 0))
    client, errors = visit(browser, address)
    until(client, splats_show(client))
    client.get_by_role("button", name="play").evaluate("button => button.click()")
    until(client, lambda: page.session.frame > 2, 300)
    before = picture(client)
    ball_at = np.argwhere(before.std(axis=2) > 12).mean(0)
    x, y = 320 + ball_at[1], ball_at[0]
    start = np.asarray(page.session.live.particles.x).mean(0)
    client.mouse.move(x, y)
    client.mouse.down()
    client.mouse.move(x - 20, y - 20, steps=4)
    client.mouse.move(x - 60, y - 60, steps=6)
    until(client, lambda: page.session.live.holds)
    begun = page.session.frame
    until(client, lambda: page.session.frame > begun + 45 or not page.playing, 300)  # 1.5 s, three periods of the hand
    moved = np.linalg.norm(np.asarray(page.session.live.particles.x).mean(0) - start)
    assert moved > 0.03, f"frame {page.session.frame}, {page.said.content}, {page.pace.content}"
    client.mouse.up()
    until(client, lambda: not page.session.live.holds)
    assert np.asarray(page.session.live.particles.x).mean(0)[2] > start[2] + 0.01  # dragged up
    until(client, changed(client, before))
    assert unknown(errors) == []
    client.close()


def test_a_click_selects_an_object_and_a_file_is_written(browser, serve, folder):
    page, address = serve(folder / "cloud.ply")
    client, errors = visit(browser, address)
    until(client, splats_show(client))
    x, y = np.argwhere(picture(client).std(axis=2) > 12).mean(0)[::-1]
    page._selected = -7
    client.mouse.click(320 + x, y)
    until(client, lambda: page._selected == 1)
    client.get_by_role("button", name="write").evaluate("button => button.click()")
    until(client, (folder / "scene-edited.toml").exists)
    assert load_scene(folder / "scene-edited.toml").objects["cloud"].material == "jelly"
    assert unknown(errors) == []
    client.close()
