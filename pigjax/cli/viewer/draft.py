"""A scene file being written: objects with names, materials, velocities; gravity; a ground; checked at each change."""

from __future__ import annotations

import copy
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pigjax import io
from pigjax.core.errors import InputError, SceneError
from pigjax.mpm.materials import PRESETS
from pigjax.scene import Scene, scene_from
from pigjax.scene.schema import INPUT_FILES, OF_MATTER, OF_MOTION, OF_STILL

GROUND = "ground"
_ROUND = 6  # digits of numbers from a page


class Draft:
    """Values of a scene file, as TOML gives them, that a user changes.

    Args:
        values: of the file, or of a new one; not changed.
        base: folder that the paths in it begin from.
        folder: where the file is written.
        accuracy: level instead of the file's; None: the file's.
    """

    def __init__(self, values: dict[str, Any], base: Path, folder: Path, *, accuracy: str | None = None) -> None:
        self.values = copy.deepcopy(values)
        self.base, self.folder, self.accuracy = base, folder, accuracy

    def scene(self) -> Scene:
        """The scene of the values.

        Raises:
            SceneError: something in them is impossible; the message names the field.
        """
        return scene_from(self.values, folder=self.base, accuracy=self.accuracy)

    @property
    def objects(self) -> dict[str, dict[str, Any]]:
        """Tables of the objects by name."""
        return self.values.setdefault("objects", {})

    def add(self, name: str, number: int) -> None:
        """Give an id of the masks a place in the scene: a fixed object, until it gets a material.

        Raises:
            SceneError: the name is empty or taken.
        """
        self._check_free(name)
        self.objects[name] = {"id": number, "fixed": True}

    def name_object(self, old: str, new: str, number: int) -> None:
        """Give an object another name. Its id is written down, since the masks do not know the new name.

        Raises:
            SceneError: the name is empty or taken.
        """
        if new == old:
            return
        self._check_free(new)
        self.values["objects"] = {(new if name == old else name): table for name, table in self.objects.items()}
        self.objects[new].setdefault("id", number)

    def remove(self, name: str) -> None:
        """Leave an object out: it is drawn, and nothing collides with it."""
        self.objects.pop(name, None)

    def make_fixed(self, name: str) -> None:
        """Make an object a still collider, without material, velocity and splats of its own."""
        kept = {key: value for key, value in self.objects[name].items() if key not in OF_MATTER + OF_MOTION}
        self.objects[name] = {**kept, "fixed": True}

    def set_material(self, name: str, preset: str) -> None:
        """Make an object of a preset's matter; its own numbers go, its place and motion stay.

        Raises:
            SceneError: there is no such preset.
        """
        if preset not in PRESETS:
            raise SceneError(f"objects.{name}.material = {preset!r}: choose one of {', '.join(PRESETS)}.")
        kept = {key: value for key, value in self.objects[name].items() if key not in OF_MATTER + OF_STILL}
        self.objects[name] = {**kept, "material": preset}

    def set_number(self, name: str, field: str, value: float | int) -> None:
        """Change one number of an object's material, such as its Young's modulus.

        Raises:
            SceneError: the object is fixed, or the number is out of range; the former one stays.
        """
        self._try(("objects", name, field), round_number(value))

    def set_velocity(self, name: str, velocity: Sequence[float | int]) -> None:
        """Initial velocity of an object [m/s].

        Raises:
            SceneError: the object is fixed, or a number is out of range; the former one stays.
        """
        self._try(("objects", name, "velocity"), [round_number(value) for value in velocity])

    def set_gravity(self, gravity: Sequence[float | int]) -> None:
        """Gravity as a vector [m/s²].

        Raises:
            SceneError: a number is out of range; the former one stays.
        """
        self._try(("simulation", "gravity"), [round_number(value) for value in gravity])

    def set_ground(self, point: Sequence[float | int] | None, normal: Sequence[float | int] = (0.0, 0.0, 1.0)) -> None:
        """Put a plane under the scene, or take it away.

        Args:
            point: on the plane [m]; None: no ground.
            normal: out of it.

        Raises:
            SceneError: a number is out of range; the former ground stays.
        """
        if point is None:
            planes = self.values.get("planes", {})
            planes.pop(GROUND, None)
            if not planes:
                self.values.pop("planes", None)
            return
        former = self.values.get("planes", {}).get(GROUND, {"friction": 0.5})
        place = {"point": [round_number(value) for value in point], "normal": [float(value) for value in normal]}
        self._try(("planes", GROUND), {**former, **place})

    def write(self, name: str, *, overwrite: bool = False) -> Path:
        """Write the scene file into the folder, and give its path.

        Args:
            name: of the file; it cannot lead out of the folder.
            overwrite: replace a file of that name.

        Raises:
            SceneError: the scene is impossible.
            InputError: there is such a file, or it cannot be written.
        """
        self.scene()
        path = self.folder / f"{io.safe_name(name.removesuffix('.toml'))}.toml"
        if path.exists() and not overwrite:
            raise InputError(f"{path.name}: is there already; choose another name, or tick 'replace'.")
        values = copy.deepcopy(self.values)
        for key in set(INPUT_FILES) & values["input"].keys():
            values["input"][key] = os.path.relpath(self.base / values["input"][key], self.folder)
        for table in values.get("objects", {}).values():
            if "gaussians" in table:
                table["gaussians"] = os.path.relpath(self.base / table["gaussians"], self.folder)
        io.write_toml(path, values)
        return path

    def _try(self, place: tuple[str, ...], value: Any) -> None:
        before = copy.deepcopy(self.values)
        table = self.values
        for key in place[:-1]:
            table = table.setdefault(key, {})
        table[place[-1]] = value
        try:
            self.scene()
        except SceneError:
            self.values = before
            raise

    def _check_free(self, name: str) -> None:
        if not name.strip():
            raise SceneError("objects: a name is empty; give one.")
        if name in self.objects:
            raise SceneError(f"objects.{name}: is there already; choose another name.")


def round_number(value: float | int) -> float:
    """A number of a page without the noise of its last digits."""
    return float(f"{float(value):.{_ROUND}g}")
