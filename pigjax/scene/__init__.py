"""Scene file → plan (particles, colliders, settings) → run."""

from pigjax.scene.budget import ScenePlan, plan_scene
from pigjax.scene.export import export_run
from pigjax.scene.replay import Run, load_run
from pigjax.scene.report import RunReport, StageTime
from pigjax.scene.run import run_scene
from pigjax.scene.schema import Scene, load_scene, scene_from

__all__ = [
    "Run",
    "RunReport",
    "Scene",
    "ScenePlan",
    "StageTime",
    "export_run",
    "load_run",
    "load_scene",
    "plan_scene",
    "run_scene",
    "scene_from",
]
