"""
Out-of-core merge
=================

Models are merged in tiles of the world lattice. A tile reads only the windows of the models that touch it, so memory
does not grow with the length of the sequence. ``terrain.zarr`` keeps the tiles as chunks, and xarray reads them lazily.
"""

# %%
# Cells of 1 mm give several tiles.

import json

import matplotlib.pyplot as plt

import rille

small = {"frames": 9, "image_width": 285, "image_height": 260, "focal_length": 300.0}
run = rille.reconstruct(
    rille.open("mockup-short", mockup=small),
    executor="inline",
    locus={"cell_size": 0.001},
    keyframes={"stride": 2},
    crosscheck={"enabled": False},
)

# %%
# The ledger says of each task what it read. Each tile is one task, which reads only the models that touch it.

rows = [json.loads(line) for line in (run.folder / "ledger.jsonl").read_text().splitlines()]
tiles = [row for row in rows if row.get("stage") == "merge"]
for tile in tiles:
    print(f"{tile['label']}: {len(tile['inputs']['dems'])} models, {tile['seconds']:.2f} s")

# %%
# ``run.terrain`` reads nothing yet. ``chunk()`` makes its arrays dask's, a chunk a tile of the file.

elevation = run.terrain.elevation.chunk()
print(elevation.shape, elevation.encoding["preferred_chunks"])

# %%
# A coarse overview is computed chunk by chunk. A window reads its own chunks alone.

overview = elevation.coarsen(x=8, y=8, boundary="trim").mean()
window = elevation.sel(x=slice(-0.05, 0.1), y=slice(0.55, 0.4))

figure, axes = plt.subplots(1, 2, figsize=(9, 4), layout="constrained")
overview.plot(ax=axes[0], cmap="terrain")
axes[0].set_title("overview, cells of 8 mm")
window.plot(ax=axes[1], cmap="terrain")
axes[1].set_title("window, cells of 1 mm")
