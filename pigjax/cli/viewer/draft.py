"""A scene file being written: objects with names, materials, velocities; gravity; a ground; checked at each change."""

from __future__ import annotations

import copy
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from pigjax import io
from pigjax.core.errors import InputError, SceneError
from pigjax.mpm.materials import PRESETS
from pigjax.scene import Scene, scene_from
from pigjax.scene.arrangement import name_of_copy
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
        write_inputs: writes the files that the values name and that are not there yet; None: all are there.
    """

    def __init__(
        self,
        values: dict[str, Any],
        base: Path,
        folder: Path,
        *,
        accuracy: str | None = None,
        write_inputs: Callable[[], None] | None = None,
    ) -> None:
        self.values = copy.deepcopy(values)
        self.base, self.folder, self.accuracy = base, folder, accuracy
        self._write_inputs = write_inputs

    def scene(self) -> Scene:
        """The scene of the values.

        Raises:
            SceneError: something in them is impossible; the message names the field.
        """
        return scene_from(self.values, folder=self.base, accuracy=self.accuracy)

    @property
    def objects(self) -> dict[str, dict[str, Any]]:
        """Tables of the captured objects by name."""
        return self.values.get("objects", {})

    def table(self, name: str) -> dict[str, Any] | None:
        """Table of an object, of a volume, or of the object that a copy is of; None: it is not in the scene."""
        place = self._place(name)
        return None if place is None else self.values[place[0]][place[1]]

    def owner(self, name: str) -> str:
        """Name of the object that a copy is of; the name itself of all else."""
        place = self._place(name)
        return name if place is None else place[1]

    def is_copy(self, name: str) -> bool:
        """Whether a name is that of a copy, whose fields are its object's."""
        return self.owner(name) != name

    def name_object(self, old: str, new: str, number: int) -> None:
        """Give an object or a volume another name, also where volumes and forces name it.

        The id of an object is written down where masks or labels have it, since they do not know the new name.

        Raises:
            SceneError: the name is empty, taken, or a copy's.
        """
        if new == old:
            return
        self.check_free(new)
        place = self._own_place(old)

        def change(values: dict[str, Any]) -> None:
            section = place[0]
            values[section] = {(new if name == old else name): table for name, table in values[section].items()}
            if section == "objects" and "gaussians" not in values[section][new]:
                values[section][new].setdefault("id", number)
            for volume in values.get("volumes", {}).values():
                if volume.get("fills") == old:
                    volume["fills"] = new
            for force in values.get("forces", {}).values():
                if "objects" in force:
                    force["objects"] = [new if name == old else name for name in force["objects"]]

        self._try(change)

    def remove(self, name: str) -> None:
        """Leave an object out: it is drawn, and nothing collides with it. A volume is no more.

        Raises:
            SceneError: the scene cannot be without it, as a vessel that a volume fills; or it is a copy.
        """
        if self.table(name) is None:
            return
        section, _ = self._own_place(name)
        self._try(lambda values: values[section].pop(name))

    def make_fixed(self, name: str, number: int | None = None) -> None:
        """Make an object a still collider, without material, velocity and splats of its own.

        Args:
            name: of the object.
            number: its id, where it is not in the scene yet.

        Raises:
            SceneError: the scene cannot be so, as where nothing else moves or a force acts on it.
        """
        if name in self.values.get("volumes", {}):
            raise SceneError(f"volumes.{name}: only captured objects are fixed; a volume is of matter.")
        self._take(name, number, OF_MATTER + OF_MOTION, {"fixed": True})

    def set_material(self, name: str, preset: str, number: int | None = None) -> None:
        """Make an object of a preset's matter; its own numbers go, its place and motion stay.

        Args:
            name: of the object or volume.
            preset: name of the material.
            number: id of an object that is not in the scene yet.

        Raises:
            SceneError: there is no such preset, or the scene cannot be so, as where a volume fills the object.
        """
        if preset not in PRESETS:
            raise SceneError(f"objects.{name}.material = {preset!r}: choose one of {', '.join(PRESETS)}.")
        self._take(name, number, OF_MATTER + OF_STILL, {"material": preset})

    def _take(self, name: str, number: int | None, less: Sequence[str], more: dict[str, Any]) -> None:
        """Replace fields of a table, which is made where an id is given and there is none."""
        section, key = self._place(name) or ("objects", name)
        table = self.table(name)
        if table is None:
            self.check_free(name)
            table = {} if number is None else {"id": number}
        kept = {field: value for field, value in table.items() if field not in less}
        self._set((section, key), {**kept, **more})

    def set_number(self, name: str, field: str, value: float | int) -> None:
        """Change one number of an object's material, such as its Young's modulus.

        Raises:
            SceneError: the object is fixed, or the number is out of range; the former one stays.
        """
        self._set((*self._known_place(name), field), round_number(value))

    def set_velocity(self, name: str, velocity: Sequence[float | int]) -> None:
        """Initial velocity of an object [m/s].

        Raises:
            SceneError: the object is fixed, or a number is out of range; the former one stays.
        """
        self._set((*self._known_place(name), "velocity"), [round_number(value) for value in velocity])

    def set_gravity(self, gravity: Sequence[float | int]) -> None:
        """Gravity as a vector [m/s²].

        Raises:
            SceneError: a number is out of range; the former one stays.
        """
        self._set(("simulation", "gravity"), [round_number(value) for value in gravity])

    def set_ground(self, point: Sequence[float | int] | None, normal: Sequence[float | int] = (0.0, 0.0, 1.0)) -> None:
        """Put a plane under the scene, or take it away.

        Args:
            point: on the plane [m]; None: no ground.
            normal: out of it.

        Raises:
            SceneError: a number is out of range; the former ground stays.
        """
        if point is None:
            self._try(_without_ground)
            return
        former = self.values.get("planes", {}).get(GROUND, {"friction": 0.5})
        place = {"point": [round_number(value) for value in point], "normal": [float(value) for value in normal]}
        self._set(("planes", GROUND), {**former, **place})

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
        if self._write_inputs is not None:
            self._write_inputs()
        io.write_toml(path, values)
        return path

    def check_free(self, name: str) -> None:
        """Refuse a name that an object, a copy or a volume has.

        Raises:
            SceneError: it is taken, or empty.
        """
        if not name.strip():
            raise SceneError("objects: a name is empty; give one.")
        if (place := self._place(name)) is not None:
            raise SceneError(f"{place[0]}.{name}: is there already; choose another name.")

    def _place(self, name: str) -> tuple[str, str] | None:
        """Section and key of the table of an object, a copy or a volume."""
        for section in ("objects", "volumes"):
            if name in self.values.get(section, {}):
                return section, name
        for owner, table in self.objects.items():
            if name in (name_of_copy(owner, k) for k in range(1, len(table.get("copies", ())) + 1)):
                return "objects", owner
        return None

    def _known_place(self, name: str) -> tuple[str, str]:
        if (place := self._place(name)) is None:
            raise SceneError(f"{name}: is not in the scene; give it a material first.")
        return place

    def _own_place(self, name: str) -> tuple[str, str]:
        place = self._known_place(name)
        if place[1] != name:
            raise SceneError(
                f"{name}: is a copy of objects.{place[1]}; change that, or its field 'copies' in the file."
            )
        return place

    def _set(self, place: tuple[str, ...], value: Any) -> None:
        def change(values: dict[str, Any]) -> None:
            for key in place[:-1]:
                values = values.setdefault(key, {})
            values[place[-1]] = value

        self._try(change)

    def _try(self, change: Callable[[dict[str, Any]], Any]) -> None:
        """Change the values, unless they then were no scene."""
        values = copy.deepcopy(self.values)
        change(values)
        scene_from(values, folder=self.base, accuracy=self.accuracy)
        self.values = values


def _without_ground(values: dict[str, Any]) -> None:
    values.get("planes", {}).pop(GROUND, None)
    if not values.get("planes"):
        values.pop("planes", None)


def round_number(value: float | int) -> float:
    """A number of a page without the noise of its last digits."""
    return float(f"{float(value):.{_ROUND}g}")
