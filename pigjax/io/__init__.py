"""Files: the only package that touches them. Everything here runs on the host."""

from pigjax.core.views import Views
from pigjax.io.archives import (
    load_array,
    load_arrays,
    plain_label,
    save_arrays,
    save_figure,
    write_csv,
    write_parquet,
)
from pigjax.io.cameras import describe_capture, load_cameras, load_views
from pigjax.io.datasets import LAYOUTS, Dataset, id_named, load_dataset, load_names
from pigjax.io.files import (
    decoding,
    output_folder,
    read_json,
    read_toml,
    remove,
    safe_name,
    safe_names,
    toml_text,
    write_json,
    write_text,
    write_toml,
    writing,
)
from pigjax.io.finding import example_folder, parts_beside
from pigjax.io.formats import load_gaussians, origin_of, read_gaussians
from pigjax.io.gltf import Mesh, save_glb, save_mesh
from pigjax.io.images import contact_sheet, data_uri, read_image, write_image
from pigjax.io.labels import StoredLabels, digest_of_scene, load_labels, save_labels
from pigjax.io.masks import load_masks, load_stroke, save_masks
from pigjax.io.page import save_page
from pigjax.io.ply import load_ply, load_points, read_ply, save_ply
from pigjax.io.points import save_points
from pigjax.io.provenance import check_same, claim, digest, file_digest, parts_of
from pigjax.io.result_cache import kept
from pigjax.io.state import (
    ROWS,
    STATES,
    last_state,
    load_pytree,
    load_rows,
    load_state,
    readable_states,
    remove_state,
    resumed,
    save_pytree,
    save_rows,
    save_state,
    set_aside,
    signed,
    state_frames,
)
from pigjax.io.usd import read_usd, save_usd
from pigjax.io.video import read_video, write_video

__all__ = [
    "LAYOUTS",
    "ROWS",
    "STATES",
    "Dataset",
    "Mesh",
    "StoredLabels",
    "Views",
    "check_same",
    "claim",
    "contact_sheet",
    "data_uri",
    "decoding",
    "describe_capture",
    "digest",
    "digest_of_scene",
    "example_folder",
    "file_digest",
    "id_named",
    "kept",
    "last_state",
    "load_array",
    "load_arrays",
    "load_cameras",
    "load_dataset",
    "load_gaussians",
    "load_labels",
    "load_masks",
    "load_names",
    "load_ply",
    "load_points",
    "load_pytree",
    "load_rows",
    "load_state",
    "load_stroke",
    "load_views",
    "origin_of",
    "output_folder",
    "parts_beside",
    "parts_of",
    "plain_label",
    "read_gaussians",
    "read_image",
    "read_json",
    "read_ply",
    "read_toml",
    "read_usd",
    "read_video",
    "readable_states",
    "remove",
    "remove_state",
    "resumed",
    "safe_name",
    "safe_names",
    "save_arrays",
    "save_figure",
    "save_glb",
    "save_labels",
    "save_masks",
    "save_mesh",
    "save_page",
    "save_ply",
    "save_points",
    "save_pytree",
    "save_rows",
    "save_state",
    "save_usd",
    "set_aside",
    "signed",
    "state_frames",
    "toml_text",
    "write_csv",
    "write_image",
    "write_json",
    "write_parquet",
    "write_text",
    "write_toml",
    "write_video",
    "writing",
]
