"""Which programs open the files of a run, and whether they read what Rille wrote: a row a program, with its version.

``python benchmarks/programs.py [RUN_FOLDER]``; the run is the latest of `mockup-short` by default. Fails if a program
reads something else. Python packages come with `make install`; three.js comes with trimesh and runs in
``chromium``. Others are asked where they are installed: ``gdalinfo`` and ``pdal`` on the path, QGIS's module of
``/usr/bin/python3``, ``rio-cogeo`` of the environment that ``COGEO`` names (a folder with ``bin/rio``), Khronos'
validator in the ``node_modules`` that ``GLTF_VALIDATOR`` names.
"""

from __future__ import annotations

import base64
import contextlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pycolmap
import rasterio
import trimesh
import xarray
from evo.tools import file_interface

import rille
from rille.pipeline.engine.store.base import Store
from rille.pipeline.export.programs import colmap as colmap_export
from rille.pipeline.export.programs.run_artifacts import export_run
from rille.pipeline.runs.options import cache_folder

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "pipeline"))
from toys import map_server
from toys.browser import Browser

RASTERS = ("dem", "dem_sigma", "slope", "hillshade", "ortho", "risk", "hazard", "reason")
EXPORTS = ("run.laz", "run.ply", "run.glb", "colmap", "nav2")

QGIS = """
import sys
from qgis.core import Qgis, QgsApplication, QgsRasterLayer, QgsVectorLayer, QgsPointXY
app = QgsApplication([], False); app.initQgis()
said = []; QgsApplication.messageLog().messageReceived.connect(lambda *a: said.append(a[0]))
layers = [QgsRasterLayer(p, p) for p in sys.argv[1:-1]] + [QgsVectorLayer(sys.argv[-1] + '|layername=path', 'path')]
assert all(l.isValid() for l in layers), [l.source() for l in layers if not l.isValid()]
wkt = {l.crs().toWkt() for l in layers}
assert len(wkt) == 1, wkt
kinds = [l.renderer().type() for l in layers[:-1]]
assert 'paletted' in kinds, kinds
assert not said, said
words = f'{len(layers)} layers, one CRS, classes of risk in colours, no warning'
print(Qgis.QGIS_VERSION.split('-')[0] + '|' + words)
"""

GLTF = """
const v = require(process.argv[1] + '/gltf-validator'), fs = require('fs');
v.validateBytes(new Uint8Array(fs.readFileSync(process.argv[2]))).then((r) => {
  const n = r.issues;
  if (n.numErrors || n.numWarnings) { console.error(JSON.stringify(n.messages)); process.exit(1); }
  console.log(v.version() + '|' + r.info.totalTriangleCount + ' triangles, no error, no warning');
});
"""


THREE = """
new Promise((done) => {
  if (document.readyState === 'complete') done(); else addEventListener('load', () => done());
}).then(() => new Promise((done, fail) => {
  const bytes = Uint8Array.from(atob(document.getElementById('glb').textContent), (c) => c.charCodeAt(0));
  new THREE.GLTFLoader().parse(bytes.buffer, '', (found) => {
    const scene = new THREE.Scene(), camera = new THREE.PerspectiveCamera(50, 1, 0.01, 1000);
    scene.add(found.scene, new THREE.AmbientLight(0xffffff, 1));
    const box = new THREE.Box3().setFromObject(found.scene), size = box.getSize(new THREE.Vector3());
    camera.position.set(0, 2 * Math.max(size.x, size.z), 0.01); camera.lookAt(0, 0, 0);
    const renderer = new THREE.WebGLRenderer({ preserveDrawingBuffer: true });
    let texture = 0;
    found.scene.traverse((m) => { if (m.isMesh && m.material.map) texture = m.material.map.image.width; });
    renderer.render(scene, camera);
    const gl = renderer.getContext(), w = gl.drawingBufferWidth, h = gl.drawingBufferHeight;
    const p = new Uint8Array(4 * w * h);
    gl.readPixels(0, 0, w, h, gl.RGBA, gl.UNSIGNED_BYTE, p);
    let drawn = 0;
    for (let i = 0; i < p.length; i += 4) drawn += p[i] + p[i + 1] + p[i + 2] > 0;
    done([THREE.REVISION, renderer.info.render.triangles, texture, size.y, drawn / (w * h)]);
  }, fail);
}))
"""


def run_of(*command: str | Path, **kw: Any) -> str:
    done = subprocess.run([str(c) for c in command], capture_output=True, text=True, check=False, **kw)
    if done.returncode:
        raise AssertionError(" ".join(done.stderr.split())[-300:])
    return done.stdout


class Opened:
    """A run with its exports, and what is right: the elevations of ``dem.tif`` as rasterio reads them."""

    def __init__(self, run: Path, exports: Path) -> None:
        self.run, self.exports, self.cache = run, exports, cache_folder(None)
        rille_command = Path(sys.executable).with_name("rille")
        for name in EXPORTS:
            run_of(rille_command, "export", run, "--to", name.rpartition(".")[2], "-o", exports / name)
        with rasterio.open(run / "dem.tif") as dem:
            self.z, self.crs = dem.read(1), dem.crs
        self.known = int(np.isfinite(self.z).sum())
        self.range = float(np.nanmin(self.z)), float(np.nanmax(self.z))

    def rasters(self) -> list[Path]:
        return [self.run / f"{name}.tif" for name in RASTERS]


def gdal_within(o: Opened) -> tuple[str, str]:
    for path in o.rasters():
        with rasterio.open(path) as found:
            assert found.crs == o.crs, path
            assert found.shape == o.z.shape, path
    with rasterio.open(f'ZARR:"{o.run / "terrain.zarr"}":/elevation') as found:
        np.testing.assert_array_equal(found.read(1), o.z)
    return rasterio.__gdal_version__, f"{len(RASTERS)} GeoTIFFs, one CRS; terrain.zarr: the same elevations"


def gdal_of_the_system(o: Opened) -> tuple[str, str]:
    for path in o.rasters():
        said = json.loads(run_of("gdalinfo", "-json", path))
        assert said["size"] == [o.z.shape[1], o.z.shape[0]]
    dem = shutil.copyfile(o.run / "dem.tif", o.exports / "dem.tif")  # it writes a file beside
    stats = json.loads(run_of("gdalinfo", "-json", "-stats", dem))
    found = stats["bands"][0]["metadata"][""]
    least_and_most = float(found["STATISTICS_MINIMUM"]), float(found["STATISTICS_MAXIMUM"])
    assert np.allclose(least_and_most, o.range, atol=1e-5), least_and_most
    return run_of("gdalinfo", "--version").split()[1].strip(
        ","
    ), f"{len(RASTERS)} GeoTIFFs, least and greatest elevation"


def cogeo(o: Opened) -> tuple[str, str]:
    rio = Path(os.environ["COGEO"]) / "bin" / "rio"
    for path in o.rasters():
        said = run_of(rio, "cogeo", "validate", "--strict", path)
        assert "is a valid cloud optimized GeoTIFF" in said, said
    words = run_of(rio, "cogeo", "--version").split()
    return words[-1], f"{len(RASTERS)} files are valid cloud optimized GeoTIFFs, strictly"


def qgis(o: Opened) -> tuple[str, str]:
    with tempfile.TemporaryDirectory() as home:
        environment = {"QT_QPA_PLATFORM": "offscreen", "HOME": home, "PATH": "/usr/bin", "XDG_RUNTIME_DIR": home}
        files = [*o.rasters(), o.run / "path.gpkg"]
        found, words = run_of("/usr/bin/python3", "-c", QGIS, *files, env=environment).strip().split("|")
    return found, words


def by_xarray(o: Opened) -> tuple[str, str]:
    np.testing.assert_array_equal(xarray.open_zarr(o.run / "terrain.zarr").elevation, o.z)
    with tempfile.TemporaryDirectory() as folder:
        rille.open_run(o.run).terrain.to_netcdf(f"{folder}/terrain.nc", engine="scipy")
        with xarray.open_dataset(f"{folder}/terrain.nc", engine="scipy") as again:
            np.testing.assert_array_equal(again.elevation, o.z)
    return version("xarray"), "terrain.zarr, and the same saved as NetCDF"


def evo(o: Opened) -> tuple[str, str]:
    tum = file_interface.read_tum_trajectory_file(str(o.run / "trajectory.tum"))
    kitti = file_interface.read_kitti_poses_file(str(o.run / "trajectory.kitti"))
    for trajectory in (tum, kitti):
        ok, what = trajectory.check()
        assert ok, what
    np.testing.assert_allclose(tum.positions_xyz, kitti.positions_xyz, atol=1e-6)
    return version("evo"), f"{tum.num_poses} poses as TUM and as KITTI, equal positions"


def colmap(o: Opened) -> tuple[str, str]:
    model = pycolmap.Reconstruction(str(o.exports / "colmap"))
    before = {name: image.projection_center() for name, image in ((i.name, i) for i in model.images.values())}
    stated = model.compute_mean_reprojection_error()
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_extra_params = options.refine_sensor_from_rig = False
    options.print_summary = False
    pycolmap.bundle_adjustment(model, options)
    sigma = {r["name"]: r["sigma_m"] for r in json.loads((o.run / "report.json").read_text())["frames"]}
    centres = [i for i in model.images.values() if i.name.startswith("left/")]
    moved = np.array([np.linalg.norm(i.projection_center() - before[i.name]) for i in centres])
    # The first pose is the world's origin: it has no error, and an adjustment may move all together.
    by = max(m / s for m, i in zip(moved, centres, strict=True) if (s := sigma[i.name.split("/")[1]]))
    assert by <= 3.0, by
    ours, theirs = back_projection(o)
    assert abs(theirs / ours - 1.0) < 0.02, (ours, theirs)
    words = (
        f"{model.num_images()} images, {model.num_points3D()} points, {stated:.2f} px; with all observations "
        f"{theirs:.3f} px a frame, in the report {ours:.3f}; adjustment moves a centre by "
    )
    return version("pycolmap"), words + f"{1e3 * moved.max():.2f} mm at most, {by:.1f} of its standard deviations"


def back_projection(o: Opened) -> tuple[float, float]:
    """Median over frames of the RMS error in the left images: as the report has it, and by pycolmap.

    The model is exported once more with every observation that agrees with the pose: the report counts those far off,
    too. Landmarks are told of by the frames after the key frame, which they come from.
    """
    rows = {r["name"]: r for r in json.loads((o.run / "report.json").read_text())["frames"] if r["rms_px"] is not None}
    with tempfile.TemporaryDirectory() as folder:
        limit, colmap_export.MAX_REPROJECTION_PX = colmap_export.MAX_REPROJECTION_PX, np.inf
        export_run("colmap", o.run, Path(folder) / "all", Store(o.cache))
        colmap_export.MAX_REPROJECTION_PX = limit
        model = pycolmap.Reconstruction(f"{folder}/all")
    found = []
    for image in (i for i in model.images.values() if i.name.split("/")[1] in rows and i.name.startswith("left/")):
        seen = [(p.xy, model.points3D[p.point3D_id]) for p in image.points2D if p.has_point3D()]
        followed = [(xy, p) for xy, p in seen if min(e.image_id for e in p.track.elements) < image.image_id]
        miss = np.array([image.project_point(p.xyz) - xy for xy, p in followed])
        found.append(float(np.sqrt((miss**2).sum(axis=1).mean())))
    return float(np.median([r["rms_px"] for r in rows.values()])), float(np.median(found))


def by_laspy(o: Opened) -> tuple[str, str]:
    cloud = laspy.read(o.exports / "run.laz")
    ply = trimesh.load(o.exports / "run.ply", file_type="ply")
    assert len(cloud.points) == len(ply.vertices) > o.known
    assert np.abs(cloud.xyz - ply.vertices).max() <= cloud.header.scales[0]
    return version("laspy"), f"{len(cloud.points)} points, colours, sigma"


def pdal(o: Opened) -> tuple[str, str]:
    copy = shutil.copyfile(o.exports / "run.laz", o.exports / "cloud.laz")
    found = json.loads(run_of("pdal", "info", "--stats", copy))["stats"]["statistic"]
    z, points = next(s for s in found if s["name"] == "Z"), laspy.read(copy)
    assert z["count"] == len(points)
    assert np.allclose((z["minimum"], z["maximum"]), (points.z.min(), points.z.max()), atol=1e-4)
    assert any(s["name"] == "sigma_along" for s in found)
    return run_of("pdal", "--version").split("pdal ")[1].split()[0], f"{len(points)} points, colours, sigma"


def by_trimesh(o: Opened) -> tuple[str, str]:
    cloud = trimesh.load(o.exports / "run.ply", file_type="ply")
    (mesh,) = trimesh.load(o.exports / "run.glb", file_type="glb").geometry.values()
    return version("trimesh"), f"PLY: {len(cloud.vertices)} points; GLB: {len(mesh.faces)} triangles with texture"


def three(o: Opened) -> tuple[str, str]:
    template = trimesh.util.decompress(trimesh.resources.get_bytes("templates/viewer.zip"), file_type="zip")
    page = template["viewer.html.template"].read().decode().split("var camera,controls,scene,renderer")[0]
    glb = base64.b64encode((o.exports / "run.glb").read_bytes()).decode()
    (o.exports / "three.html").write_text(f'{page}</script><script type="text/plain" id="glb">{glb}</script>')
    browser = Browser(str(shutil.which("chromium")), o.exports)
    try:
        browser.ask("Page.navigate", url=(o.exports / "three.html").as_uri())
        browser.run(
            "new Promise((d) => document.readyState === 'complete' ? d() : addEventListener('load', () => d()))"
        )
        revision, triangles, texture, height, drawn = browser.run(THREE)
        assert not browser.messages, browser.messages
    finally:
        browser.close()
    (mesh,) = trimesh.load(o.exports / "run.glb", file_type="glb").geometry.values()
    assert triangles == len(mesh.faces)
    up = np.ptp(mesh.vertices[np.unique(mesh.faces), 1])  # a peak of one cell is in no triangle
    assert np.isclose(height, up, rtol=1e-4), (height, up)
    assert texture > 1
    assert drawn > 0.02, drawn
    return f"r{revision}", f"GLB: {triangles} triangles drawn, texture of {texture} columns"


def nav2(o: Opened) -> tuple[str, str]:
    with rasterio.open(o.run / "risk.tif") as risk, rasterio.open(o.run / "hazard.tif") as hazard:
        classes, p, corner = risk.read(1), hazard.read(hazard.descriptions.index("p_hazard") + 1), risk.bounds
    wanted = np.select([classes == 2, classes == 3], [100, -1], np.rint(100.0 * np.nan_to_num(p)))
    grid = map_server.load(o.exports / "nav2" / "map.yaml")
    assert np.allclose(grid.origin, (corner.left, corner.bottom), atol=1e-6), grid.origin
    np.testing.assert_array_equal(grid.data[::-1] < 0, wanted < 0)
    # hazard.tif keeps p_hazard to a thousandth, so that a half may be rounded to either side
    assert np.abs(grid.data[::-1] - wanted).max() <= 1
    return "as documented", f"map of {classes.size} cells"


def khronos(o: Opened) -> tuple[str, str]:
    found, words = run_of("node", "-e", GLTF, os.environ["GLTF_VALIDATOR"], o.exports / "run.glb").strip().split("|")
    return found, words


def there(*programs: str) -> bool:
    return all(shutil.which(p) for p in programs)


PROGRAMS: dict[str, tuple[Callable[[Opened], tuple[str, str]], bool]] = {
    "GDAL, in rasterio": (gdal_within, True),
    "GDAL, of the system": (gdal_of_the_system, there("gdalinfo")),
    "rio-cogeo": (cogeo, "COGEO" in os.environ),
    "QGIS, offscreen": (qgis, Path("/usr/lib/python3/dist-packages/qgis").is_dir()),
    "xarray": (by_xarray, True),
    "evo": (evo, True),
    "pycolmap": (colmap, True),
    "laspy": (by_laspy, True),
    "PDAL": (pdal, there("pdal")),
    "trimesh": (by_trimesh, True),
    "three.js, in chromium": (three, there("chromium")),
    "Khronos glTF validator": (khronos, "GLTF_VALIDATOR" in os.environ and there("node")),
    "nav2_map_server": (nav2, True),
}
"""Check and whether the program is here."""


def main() -> int:
    with contextlib.redirect_stdout(sys.stderr):
        run = Path(sys.argv[1]) if len(sys.argv) > 1 else rille.reconstruct("mockup-short").folder
    failed = 0
    print("| program | version | what it read |\n|---|---|---|")
    with tempfile.TemporaryDirectory() as exports:
        opened = Opened(run.resolve(), Path(exports))
        for name, (check, here) in PROGRAMS.items():
            try:
                found, words = check(opened) if here else ("-", "not installed here")
            except AssertionError as error:
                found, words, failed = "?", f"**failed**: {' '.join(str(error).split())[:300]}", failed + 1
            print(f"| {name} | {found} | {words} |", flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
