"""The report of a run: one page that tells all, fetches nothing, and escapes what files say."""

import base64
import re
from html.parser import HTMLParser
from io import BytesIO

import numpy as np
import pytest
from PIL import Image
from scenes import values, write_throw

from pigjax import io
from pigjax.core.errors import SimulationError
from pigjax.mpm.health import Health
from pigjax.scene import RunReport, load_scene, run_scene, scene_from
from pigjax.scene.report_page import chart, left_out, report_page


class Balanced(HTMLParser):
    """Raises where a tag closes another one than is open; collects texts and addresses."""

    def __init__(self, text):
        super().__init__()
        self.open, self.texts, self.addresses = [], [], []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        self.addresses += [value for name, value in attributes if name in ("src", "href")]
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        pass

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.texts.append(data)


@pytest.fixture(scope="module")
def thrown(tmp_path_factory):
    folder = write_throw(tmp_path_factory.mktemp("report"))
    return run_scene(load_scene(folder / "scene.toml"), folder / "out"), folder / "out"


def test_the_page_tells_of_the_run_and_fetches_nothing(thrown):
    report, out = thrown
    page = Balanced((out / "report.html").read_text())
    text = " ".join(page.texts)
    for word in (
        "ball",
        "jelly",
        "Left out",
        "compile s",
        "Energy [J]",
        "Stretch of the splats",
        "jaxlib",
        "dx = 0.08",
        "by colliders, pins, forces",
        "kg m/s",
        "torn matter under pressure",
    ):
        assert word in text
    drift = report.health["drift"]
    assert drift["mass_kg"] == 0
    assert not drift["alone"]
    assert len(report.health["elastic_energy_J"]) == 4
    assert max(report.health["elastic_energy_J"][1:]) > 0 == pytest.approx(report.health["elastic_energy_J"][0])
    sums = [
        np.add.reduce([report.health[f"{name}_energy_J"][k] for name in ("kinetic", "gravity", "elastic")])
        for k in (0, 3)
    ]
    assert drift["energy_J"] == pytest.approx(sums[1] - sums[0])
    assert page.addresses[0] == "video.mp4"
    assert all(address == "video.mp4" or address.startswith("data:image/jpeg;base64,") for address in page.addresses)
    picture = Image.open(BytesIO(base64.b64decode(page.addresses[1].partition(",")[2])))
    assert picture.size == Image.open(out / "contact_sheet.png").size


def test_curves_are_those_of_the_states(thrown):
    report, out = thrown
    frames = io.state_frames(out / "states")
    for index, frame in enumerate(frames):
        F = io.load_state(out / "states", frame)["F_visual"].astype(np.float64)
        volume, stretch = np.linalg.det(F), np.sqrt((F**2).sum((1, 2)) / 3)
        for name, truth in (("volume_ratio", volume), ("stretch", stretch)):
            told = [report.health[name][word][index] for word in ("least", "mean", "most")]
            np.testing.assert_allclose(told, [truth.min(), truth.mean(), truth.max()], rtol=1e-5)
    most = report.health["splat_stretch"]["most"]
    assert len(most) == len(frames)
    assert most[0] == pytest.approx(1, abs=1e-5)
    assert 1 < most[-1] < 2.5  # tau_max and lambda_S of the clamp


def test_a_run_that_breaks_down_says_so_on_its_page(tmp_path, monkeypatch):
    folder = write_throw(tmp_path)
    monkeypatch.setattr(Health, "is_broken", lambda health: True)
    monkeypatch.setattr(Health, "problems", lambda health: ["matter <left> the grid"])
    with pytest.raises(SimulationError):
        run_scene(load_scene(folder / "scene.toml"), folder / "out")
    page = Balanced((folder / "out" / "report.html").read_text())
    assert "run stopped" in " ".join(page.texts)
    assert "matter <left> the grid" in " ".join(page.texts)
    assert page.addresses == []


def test_names_and_messages_of_files_are_text():
    evil = "<script>alert(1)</script>"
    scene = scene_from(values(objects={evil: {"id": 1, "material": "jelly"}}))
    report = RunReport(warnings=[evil], modelled={evil: evil}, sizes={"gaussians_of": {evil: 3}})
    page = report_page(scene, report, settings=f'a = "{evil}"', error=evil)
    assert "<script" not in page
    assert " ".join(Balanced(page).texts).count(evil) >= 5


def test_what_is_left_out_follows_the_scene():
    report = RunReport(modelled={"sh_coefficients": 4}, sizes={"gaussians_without_particle": 7})
    alone = " ".join(left_out(scene_from(values(planes={}, simulation__fill=False)), report))
    for told in ("hollow", "Any support", "turn with the matter", "7 Gaussians"):
        assert told in alone
    assert "Contact" not in alone
    seen = {"gaussians": "cloud.ply", "views": "photos"}
    pair = {"a": {"id": 1, "material": "jelly"}, "b": {"id": 2, "material": "sand"}}
    assert "contact_friction" in " ".join(left_out(scene_from(values(input=seen, objects=pair)), report))


def test_copies_and_volumes_are_objects_of_the_page_and_removed_ones_do_not_move():
    duck = {"id": 1, "material": "jelly", "copies": [[1.0, 0, 0], [2.0, 0, 0]]}
    cup = {"id": 2, "fixed": True, "hollow": True}
    water = {"fills": "cup", "material": "water", "colour": [0, 0, 1.0]}
    seen = {"gaussians": "cloud.ply", "labels": "labels.npz"}
    gone = {"id": 3, "removed": True}
    scene = scene_from(values(input=seen, objects={"duck": duck, "cup": cup}, volumes={"water": water}))
    report = RunReport(sizes={"gaussians_of": {"duck": 11, "duck-1": 12, "duck-2": 13, "cup": 14, "water": 15}})
    texts = Balanced(report_page(scene, report, settings="")).texts
    rows = [texts[texts.index(name) + 1 :][:2] for name in ("duck", "duck-1", "duck-2", "cup", "water")]
    assert rows == [["jelly", "11"], ["jelly", "12"], ["jelly", "13"], ["fixed", "14"], ["water", "15"]]
    assert any("Contact" in text for text in left_out(scene, report)), "three ducks and water share a field"
    one = {"duck": {"id": 1, "material": "jelly"}, "cup": gone}
    alone = scene_from(values(input=seen, objects=one))
    assert "removed" in Balanced(report_page(alone, report, settings="")).texts
    assert not any("Contact" in text for text in left_out(alone, report))
    poured = scene_from(values(input=seen, objects={**one, "cup": cup}, volumes={"water": water}))
    assert any("Contact" in text for text in left_out(poured, report))


@pytest.mark.parametrize("series", [[1.0], [2.0, 2.0], [np.nan, 1.0, np.inf], [np.nan]])
def test_charts_of_odd_curves_are_finite(series):
    text = chart("a", "b", {"c": np.asarray(series)}, 0.1)
    Balanced(text)
    assert "nan" not in text
    assert "inf" not in text
    for x, y in re.findall(r"([-\d.]+),([-\d.]+)", text):
        assert 0 <= float(x) <= 460
        assert 0 <= float(y) <= 200
