"""The terrain of a run as a textured mesh (glTF 2.0 binary)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rille.pipeline.export.programs.run_artifacts import RunArtifacts
from rille.pipeline.export.read_dem import DemFile, opened_raster, read_elevation, transform_of
from rille.stages.core.errors import InputError

MAX_FACES = 2_000_000
"""Most triangles of a mesh, since browsers and phones fail with more; a larger mesh is made coarser."""
Layer = NDArray[np.float64] | None
"""Values of the cells of a terrain, (rows, cols), or colours (rows, cols, 3); None: there are none."""


def write_run(path: Path, run: RunArtifacts) -> str:
    """Write the terrain of a run as a mesh; return the content, in words.

    Raises
    ------
    InputError
        The run has no terrain.
    """
    terrain = read_elevation(run.run)
    return write_glb(path, terrain, _ortho(run.run, terrain))


def _ortho(run: Path, terrain: DemFile) -> Layer:
    """The ortho image of the run, (rows, cols) or in colours (rows, cols, 3); None: there is none."""
    path = run / "ortho.tif"
    if not path.is_file():
        return None
    with opened_raster(path) as raster:
        if raster.shape != terrain.grid.values.shape or not raster.transform.almost_equals(transform_of(terrain.grid)):
            raise InputError("RIL-602", f"{path} and dem.tif have other cells", remedy="make the run again")
        bands = raster.read([1, 2, 3] if raster.count == 3 else [1], out_dtype="float64", masked=True).filled(np.nan)
    return np.asarray(np.moveaxis(bands, 0, 2) if len(bands) == 3 else bands[0], np.float64)


def write_glb(path: Path, terrain: DemFile, ortho: Layer) -> str:
    """Write the triangles between known neighbouring cells, with the ortho image as texture.

    glTF's axes are x right, y up, z towards the viewer: x = x, y = z, z = -y of the terrain's frame. Coordinates are
    metres from the middle of the terrain (in the scene's ``extras``), since eastings as 32-bit floats would be wrong by
    decimetres. A mesh of more than :data:`MAX_FACES` triangles takes every second, third ... cell alone.
    """
    import trimesh

    step, (vertices, faces, uv) = 1, _mesh(terrain, 1)
    while len(faces) > MAX_FACES:
        step += 1
        vertices, faces, uv = _mesh(terrain, step)
    if not len(faces):
        text = f"{terrain.name}: no four neighbouring cells are known"
        raise InputError("RIL-603", text, remedy="give a more complete one")
    middle = np.round(0.5 * (vertices.min(axis=0) + vertices.max(axis=0)), 3)
    local = vertices - middle
    shown = np.column_stack([local[:, 0], local[:, 2], -local[:, 1]]).astype(np.float32)
    look = _texture(ortho)
    visual = trimesh.visual.TextureVisuals(uv=uv, material=look) if look is not None else None
    # process would merge and renumber vertices, but not their texture coordinates.
    mesh = trimesh.Trimesh(vertices=shown, faces=faces, visual=visual, process=False)
    scene = trimesh.Scene({"terrain": mesh})
    scene.metadata["origin_m"] = middle.tolist()
    scene.metadata["axes"] = "x = x, y = z, z = -y of the terrain's frame, metres from origin_m"
    scene.metadata["crs_wkt"] = terrain.crs
    path.write_bytes(scene.export(file_type="glb", include_normals=True))
    every = "" if step == 1 else f", every {step}. cell (of more than {MAX_FACES} triangles)"
    return f"{len(vertices)} vertices, {len(faces)} triangles{every}"


def _mesh(terrain: DemFile, step: int) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
    """Vertices (n, 3) in the CRS, triangles (m, 3), anticlockwise from above, and texture coordinates (n, 2)."""
    z = terrain.grid.values[::step, ::step]
    number = np.arange(z.size).reshape(z.shape)
    quads = np.stack([number[:-1, :-1], number[1:, :-1], number[:-1, 1:], number[1:, 1:]], axis=-1).reshape(-1, 4)
    a, b, c, d = quads[np.isfinite(z.ravel()[quads]).all(axis=1)].T
    # In glTF the front is the side from which corners run anticlockwise.
    corners = np.concatenate([np.column_stack([a, b, c]), np.column_stack([c, b, d])])
    used, faces = np.unique(corners, return_inverse=True)
    row, col = np.divmod(used, z.shape[1])
    col, row = col * step, row * step
    x, y = terrain.grid.matrix @ [col, row, np.ones(len(used))]
    rows, cols = terrain.grid.values.shape
    # trimesh has v = 0 at the bottom of the texture, and flips it for glTF.
    uv = np.column_stack([(col + 0.5) / cols, 1.0 - (row + 0.5) / rows])
    return np.column_stack([x, y, terrain.grid.values[row, col]]), faces.reshape(-1, 3), uv


def _texture(ortho: Layer) -> Any:
    """Material in the colours of an ortho image, grey for unknown cells."""
    if ortho is None:
        return None
    from PIL import Image
    from trimesh.visual.material import PBRMaterial

    bands = ortho if ortho.ndim == 3 else np.repeat(ortho[..., None], 3, axis=2)
    # Unknown cells are grey: black would look like a shadow.
    image = Image.fromarray(np.rint(np.clip(np.nan_to_num(bands, nan=128), 0, 255)).astype(np.uint8))
    # 4096: largest texture that every WebGL implementation takes.
    image.thumbnail((4096, 4096))
    # glTF's default material is a metal, which would mirror instead of showing the texture.
    return PBRMaterial(name="ortho", baseColorTexture=image, metallicFactor=0.0, roughnessFactor=1.0, doubleSided=True)
