"""pigjax: differentiable physics in 3D Gaussian splat scenes.

Pipeline: files (`io`) → Gaussians (`reconstruction`, or a trained file) → objects (`segmentation`) → particles
(`coupling.seeding`) → simulation (`mls_mpm`) → posed splats (`coupling.binding`, `clamp`) → pictures (`splat`) → video.
`scene` runs all of it from one file; `study` varies its parameters.
"""

from pigjax.clamp import ClampParams, eigen_clamp
from pigjax.core import __version__ as __version__
from pigjax.core.camera import Camera, interpolate_path, look_at, orbit, stack_cameras
from pigjax.core.errors import InputError, MissingFileError, SceneError, SimulationError
from pigjax.core.metrics import boundary_iou, mean_iou, psnr, ssim
from pigjax.core.placing import as_gaussians, placed
from pigjax.core.regions import BoxRegion, HalfSpace, SphereRegion
from pigjax.core.upright import Upright, find_up
from pigjax.coupling.binding import at_frame, bind, deform
from pigjax.coupling.hidden import fill_hidden
from pigjax.coupling.outliers import cut_outliers
from pigjax.coupling.own_splats import OwnSplats, make_own_splats
from pigjax.coupling.sdf_collider import collider_from_gaussians
from pigjax.coupling.seeding import seed_particles
from pigjax.coupling.vessel import vessel_from_gaussians
from pigjax.io import (
    Views,
    example_folder,
    load_dataset,
    load_gaussians,
    load_masks,
    load_ply,
    load_points,
    load_views,
    origin_of,
    save_glb,
    save_ply,
    save_usd,
    write_video,
)
from pigjax.mls_mpm import SimConfig, rollout, step
from pigjax.mpm import Grid, Health, Particles, Trajectory, fit_grid, make_particles, vast_grid
from pigjax.mpm.active_grid import choose_box
from pigjax.mpm.colliders import Box, Capsule, Cylinder, Plane, SampledDistance, Sphere
from pigjax.mpm.contact import BodyContact
from pigjax.mpm.forces import Force, ForceField, Impulse, Spring, Wind, grab
from pigjax.mpm.materials import Material, MaterialTable, material_table, preset
from pigjax.mpm.sleep import Sleep
from pigjax.mpm.timestep import choose_integrator, choose_substeps, stable_dt
from pigjax.objects.association import Association, associate_masks, compact_ids
from pigjax.objects.boundaries import Refit, cut_straddling, refit_boundaries
from pigjax.objects.editing import extract_object, hole_mask, remove_object
from pigjax.objects.evaluation import evaluate_labels
from pigjax.objects.selection import grow_selection, select_colour, select_part, select_stroke
from pigjax.reconstruction.prune import contributions, prune
from pigjax.reconstruction.reconstruct import FitConfig, reconstruct
from pigjax.scene import Run, RunReport, Scene, ScenePlan, export_run, load_run, load_scene, plan_scene, run_scene
from pigjax.scene.world import placed_cameras
from pigjax.segmentation import Labels, fill_unseen, lift_masks, object_mask
from pigjax.splat import (
    Frame,
    Gaussians,
    RenderConfig,
    Splats,
    render,
    render_over,
    required_capacity,
    surface_depth,
)
from pigjax.splatting.shadows import Light, cast_shadows, light_transmittance
from pigjax.study import Experiment, experiment, load_study, sweep_study, tune_study
from pigjax.study.optimize import Bounds, Table, fit, load_table, search, sweep

__all__ = [
    "Association",
    "BodyContact",
    "Bounds",
    "Box",
    "BoxRegion",
    "Camera",
    "Capsule",
    "ClampParams",
    "Cylinder",
    "Experiment",
    "FitConfig",
    "Force",
    "ForceField",
    "Frame",
    "Gaussians",
    "Grid",
    "HalfSpace",
    "Health",
    "Impulse",
    "InputError",
    "Labels",
    "Light",
    "Material",
    "MaterialTable",
    "MissingFileError",
    "OwnSplats",
    "Particles",
    "Plane",
    "Refit",
    "RenderConfig",
    "Run",
    "RunReport",
    "SampledDistance",
    "Scene",
    "SceneError",
    "ScenePlan",
    "SimConfig",
    "SimulationError",
    "Sleep",
    "Sphere",
    "SphereRegion",
    "Splats",
    "Spring",
    "Table",
    "Trajectory",
    "Upright",
    "Views",
    "Wind",
    "as_gaussians",
    "associate_masks",
    "at_frame",
    "bind",
    "boundary_iou",
    "cast_shadows",
    "choose_box",
    "choose_integrator",
    "choose_substeps",
    "collider_from_gaussians",
    "compact_ids",
    "contributions",
    "cut_outliers",
    "cut_straddling",
    "deform",
    "eigen_clamp",
    "evaluate_labels",
    "example_folder",
    "experiment",
    "export_run",
    "extract_object",
    "fill_hidden",
    "fill_unseen",
    "find_up",
    "fit",
    "fit_grid",
    "grab",
    "grow_selection",
    "hole_mask",
    "interpolate_path",
    "lift_masks",
    "light_transmittance",
    "load_dataset",
    "load_gaussians",
    "load_masks",
    "load_ply",
    "load_points",
    "load_run",
    "load_scene",
    "load_study",
    "load_table",
    "load_views",
    "look_at",
    "make_own_splats",
    "make_particles",
    "material_table",
    "mean_iou",
    "object_mask",
    "orbit",
    "origin_of",
    "placed",
    "placed_cameras",
    "plan_scene",
    "preset",
    "prune",
    "psnr",
    "reconstruct",
    "refit_boundaries",
    "remove_object",
    "render",
    "render_over",
    "required_capacity",
    "rollout",
    "run_scene",
    "save_glb",
    "save_ply",
    "save_usd",
    "search",
    "seed_particles",
    "select_colour",
    "select_part",
    "select_stroke",
    "ssim",
    "stable_dt",
    "stack_cameras",
    "step",
    "surface_depth",
    "sweep",
    "sweep_study",
    "tune_study",
    "vast_grid",
    "vessel_from_gaussians",
    "write_video",
]


def __dir__() -> list[str]:
    """The public names alone, for completion and `dir`; subpackages are imported by their path."""
    return sorted(__all__)
