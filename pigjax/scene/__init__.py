"""Scene file → plan (particles, colliders, settings) → run."""

from pigjax.scene.report import RunReport, StageTime
from pigjax.scene.run import run_scene
from pigjax.scene.schema import Scene, load_scene, scene_from

__all__ = ["RunReport", "Scene", "StageTime", "load_scene", "run_scene", "scene_from"]
