"""The terrain of a run as a point cloud (LAZ 1.4, PLY) and as a textured mesh (glTF 2.0 binary)."""

from __future__ import annotations

from collections.abc import Callable
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
from numpy.typing import NDArray

from rille.pipeline.engine.failures import reported
from rille.pipeline.engine.runtime import atomic
from rille.pipeline.export.colour import LUMA
from rille.pipeline.export.read_dem import DemFile, opened_raster, read_elevation
from rille.stages.core.errors import InputError

MADE = date(2000, 1, 1)
"""Date that every LAZ file states, so that equal clouds make equal files."""
STEPS_PER_CELL = 1000
"""Steps of a LAZ coordinate in one cell."""
PLY_TYPES = {"float64": "double", "float32": "float", "uint8": "uchar"}
"""PLY's names of types."""
MAX_FACES = 2_000_000
"""Most triangles of a mesh: more make browsers and phones fail; a coarser one is made beyond, and said to be."""
UNSEEN_GREY = 128
"""Grey of a cell without ortho image: neutral, for black would look like a shadow."""
MAX_TEXTURE_PX = 4096
"""Greatest edge of the texture, pixels: what every WebGL implementation takes."""

Layer = NDArray[np.float64] | None
"""Values of the cells of a terrain, (rows, cols) or of colours (rows, cols, 3), where the run has them."""


def export(run: Path, kind: str, output: Path | None) -> tuple[Path, str]:
    """Write the terrain of a run in another form; gives the file and what is in it.

    Parameters
    ----------
    run : folder of a run.
    kind : name in :data:`FORMATS`.
    output : file to write; by default the form's own name in the run's folder.

    Raises
    ------
    InputError
        The run has no terrain, or the file cannot be written.
    """
    default, write = FORMATS[kind]
    target = output or run / default
    terrain = read_elevation(run)
    ortho, sigma = _beside(run, "ortho", terrain), _beside(run, "dem_sigma", terrain)
    with reported("RIL-601", f"{target} cannot be written", remedy="name another file with -o", kind=InputError):
        return target, write(target, terrain, ortho, sigma)


def _beside(run: Path, name: str, terrain: DemFile) -> Layer:
    """Another raster of the run on the same cells, (rows, cols) or of colours (rows, cols, 3); None: there is none."""
    path = run / f"{name}.tif"
    if not path.is_file():
        return None
    with opened_raster(path) as raster:
        if raster.shape != terrain.values.shape or raster.transform != terrain.transform:
            raise InputError("RIL-602", f"{path} and dem.tif have other cells", remedy="make the run again")
        bands = raster.read([1, 2, 3] if raster.count == 3 else [1], out_dtype="float64", masked=True).filled(np.nan)
    return np.asarray(np.moveaxis(bands, 0, 2) if len(bands) == 3 else bands[0], np.float64)


def _points(terrain: DemFile, ortho: Layer, sigma: Layer) -> dict[str, NDArray[Any]]:
    """Columns (n,) of the known cells: x, y, z, and red, green, blue and ``sigma`` of z (m) where there are any."""
    row, col = np.nonzero(np.isfinite(terrain.values))
    x, y = terrain.transform @ (col + 0.5, row + 0.5)
    columns = {"x": x, "y": y, "z": terrain.values[row, col]}
    if ortho is not None:
        columns |= zip(("red", "green", "blue"), _colours(ortho)[row, col].T, strict=True)
    if sigma is not None:
        columns["sigma"] = sigma[row, col].astype(np.float32)
    return columns


def write_laz(path: Path, terrain: DemFile, ortho: Layer, sigma: Layer) -> str:
    """Write a point for each known cell: x, y, z, intensity and colour of the ortho image, ``sigma`` of z (m).

    LAS 1.4, point format 7, the CRS as WKT 1. A step of the coordinates is a thousandth of a cell or less, an elevation
    is off by half a step at most.
    """
    import laspy
    from laspy.vlrs.known import WktCoordinateSystemVlr

    points = _points(terrain, ortho, sigma)
    header = laspy.LasHeader(point_format=7, version="1.4")
    header.creation_date, header.generating_software, header.system_identifier = MADE, "Rille", "stereo"
    # LAS has coordinates of 32 bits: without offsets eastings would overflow at steps as fine as these.
    header.offsets = [float(np.floor(points[axis].min())) for axis in "xyz"]
    header.scales = np.full(3, 10.0 ** np.floor(np.log10(terrain.cell / STEPS_PER_CELL)))
    if terrain.crs:
        # LAS 1.4 allows only WKT with point formats 6 to 10, wants this bit set, and knows the first version alone.
        header.vlrs.append(WktCoordinateSystemVlr(pyproj.CRS(terrain.crs).to_wkt("WKT1_GDAL")))
        header.global_encoding.wkt = True
    if "sigma" in points:
        about = laspy.ExtraBytesParams("sigma", type=np.float32, description="standard deviation of z, m")
        header.add_extra_dim(about)
    cloud = laspy.LasData(header)
    for name, values in points.items():
        # LAS has colours of 16 bits.
        setattr(cloud, name, values.astype(np.uint16) * np.uint16(257) if values.dtype == np.uint8 else values)
    # LAS counts returns from 1: 0 of 0, which laspy leaves, is not valid.
    cloud.return_number[:] = cloud.number_of_returns[:] = 1
    if ortho is not None:
        cloud.intensity = np.rint(np.column_stack([cloud.red, cloud.green, cloud.blue]) @ LUMA).astype(np.uint16)
    with atomic.replacing(path) as temporary:
        cloud.write(str(temporary), do_compress=True)
    return f"{len(points['x'])} points"


def write_ply(path: Path, terrain: DemFile, ortho: Layer, sigma: Layer) -> str:
    """Write a point for each known cell as binary PLY: x, y, z, colour of the ortho image, ``sigma`` of z (m).

    Coordinates are 64-bit floats: eastings of 32 bits would jump by decimetres. A comment states the CRS as WKT.
    """
    columns = _points(terrain, ortho, sigma)
    count = len(columns["x"])
    kinds = [(name, values.dtype.newbyteorder("<")) for name, values in columns.items()]
    points = np.rec.fromarrays(list(columns.values()), dtype=kinds)
    # One line: a line feed would end the comment, and its rest would be read as a line of the header.
    crs = [f"comment crs {' '.join(terrain.crs.split())}"] if terrain.crs else []
    properties = [f"property {PLY_TYPES[values.dtype.name]} {name}" for name, values in columns.items()]
    lines = ["ply", "format binary_little_endian 1.0", *crs, "comment metres; sigma: standard deviation of z"]
    lines += [f"element vertex {count}", *properties, "end_header"]
    with atomic.replacing(path) as temporary:
        temporary.write_bytes("".join(f"{line}\n" for line in lines).encode() + points.tobytes())
    return f"{count} points"


def write_glb(path: Path, terrain: DemFile, ortho: Layer, sigma: Layer) -> str:
    """Write the triangles between known neighbouring cells, with the ortho image as texture.

    glTF's axes are x right, y up, z towards the viewer: x = x, y = z, z = -y of the terrain's frame. Coordinates are
    metres from the middle of the terrain, which the scene's ``extras`` name: as 32-bit floats, eastings would jump by
    decimetres. Above :data:`MAX_FACES` triangles every second, third ... cell is left out.
    """
    import trimesh

    step, (vertices, faces, uv) = 1, _mesh(terrain, 1)
    while len(faces) > MAX_FACES:
        step += 1
        vertices, faces, uv = _mesh(terrain, step)
    if not len(faces):
        raise InputError(
            "RIL-603", f"{terrain.name}: no four neighbouring cells are known", remedy="give a more complete one"
        )
    middle = np.round(0.5 * (vertices.min(axis=0) + vertices.max(axis=0)), 3)
    local = vertices - middle
    shown = np.column_stack([local[:, 0], local[:, 2], -local[:, 1]]).astype(np.float32)
    look = _texture(ortho)
    visual = trimesh.visual.TextureVisuals(uv=uv, material=look) if look is not None else None
    # process would merge vertices and number them anew, away from their texture coordinates.
    mesh = trimesh.Trimesh(vertices=shown, faces=faces, visual=visual, process=False)
    scene = trimesh.Scene({"terrain": mesh})
    scene.metadata["origin_m"] = middle.tolist()
    scene.metadata["axes"] = "x = x, y = z, z = -y of the terrain's frame, metres from origin_m"
    scene.metadata["crs_wkt"] = terrain.crs
    with atomic.replacing(path) as temporary:
        temporary.write_bytes(scene.export(file_type="glb", include_normals=True))
    every = "" if step == 1 else f", every {step}. cell (of more than {MAX_FACES} triangles)"
    return f"{len(vertices)} vertices, {len(faces)} triangles{every}"


def _colours(ortho: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Red, green and blue (rows, cols, 3) of an ortho image, grey or coloured; grey where it has no value."""
    bands = ortho if ortho.ndim == 3 else np.repeat(ortho[..., None], 3, axis=2)
    return np.rint(np.clip(np.nan_to_num(bands, nan=UNSEEN_GREY), 0, 255)).astype(np.uint8)


def _mesh(terrain: DemFile, step: int) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
    """Vertices (n, 3) in the CRS, triangles (m, 3) seen from above anticlockwise, texture coordinates (n, 2)."""
    z = terrain.values[::step, ::step]
    number = np.arange(z.size).reshape(z.shape)
    quads = np.stack([number[:-1, :-1], number[1:, :-1], number[:-1, 1:], number[1:, 1:]], axis=-1).reshape(-1, 4)
    a, b, c, d = quads[np.isfinite(z.ravel()[quads]).all(axis=1)].T
    # glTF takes the side from which corners run anticlockwise for the front.
    used, faces = np.unique(
        np.concatenate([np.column_stack([a, b, c]), np.column_stack([c, b, d])]), return_inverse=True
    )
    row, col = np.divmod(used, z.shape[1])
    at = col * step + 0.5, row * step + 0.5
    x, y = terrain.transform @ at
    rows, cols = terrain.values.shape
    # trimesh has v = 0 at the foot of the texture, and turns it when it writes glTF.
    return (
        np.column_stack([x, y, z[row, col]]),
        faces.reshape(-1, 3),
        np.column_stack([at[0] / cols, 1.0 - at[1] / rows]),
    )


def _texture(ortho: Layer) -> Any:
    if ortho is None:
        return None
    from PIL import Image
    from trimesh.visual.material import PBRMaterial

    image = Image.fromarray(_colours(ortho))
    if max(image.size) > MAX_TEXTURE_PX:
        image.thumbnail((MAX_TEXTURE_PX, MAX_TEXTURE_PX))
    # glTF's material is a metal unless told otherwise, and would mirror instead of showing the texture.
    return PBRMaterial(name="ortho", baseColorTexture=image, metallicFactor=0.0, roughnessFactor=1.0, doubleSided=True)


Writer = Callable[[Path, DemFile, Layer, Layer], str]
FORMATS: dict[str, tuple[str, Writer]] = {
    "laz": ("cloud.laz", write_laz),
    "ply": ("cloud.ply", write_ply),
    "glb": ("terrain.glb", write_glb),
}
"""Default file name and writer of each form."""
