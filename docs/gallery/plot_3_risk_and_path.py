"""
Risk and path
=============

Five pairs are merged into one terrain. The ground is judged for a vehicle, and a path keeps off its hazards.
"""

# %%
# Reconstruct a short sequence. The vehicle's limits are in metres and degrees.

import matplotlib.pyplot as plt
import numpy as np
import pyogrio
import rasterio

import rille

small = {"frames": 5, "image_width": 285, "image_height": 260, "focal_length": 300.0}
run = rille.reconstruct(
    rille.open("mockup-short", mockup=small),
    executor="inline",
    locus={"cell_size": 0.004},
    vehicle={
        "name": "toy rover",
        "wheel_diameter": 0.03,
        "track": 0.08,
        "wheel_base": 0.1,
        "clearance": 0.03,
    },
    crosscheck={"enabled": False},
)
print(
    {
        name: run.metrics[name]["value"]
        for name in ("safe", "caution", "hazardous", "unknown")
    }
)

# %%
# ``risk.tif`` holds the class of each cell, ``hazard.tif`` the probability that the exact ground breaks a limit.

with rasterio.open(run.folder / "risk.tif") as source:
    classes, box = source.read(1), source.bounds
with rasterio.open(run.folder / "hazard.tif") as source:
    p_hazard = source.read(source.descriptions.index("p_hazard") + 1)
_, _, lines, _ = pyogrio.raw.read(run.folder / "path.gpkg", layer="path")
# Well-known binary: nine bytes of head, then x, y and z of each vertex.
lines = [np.frombuffer(line[9:], "<f8").reshape(-1, 3) for line in lines if line]

colours = np.array(
    [(0.45, 0.72, 0.42), (0.96, 0.80, 0.32), (0.80, 0.25, 0.20), (0.88, 0.88, 0.88)]
)
extent = (box.left, box.right, box.bottom, box.top)
figure, axes = plt.subplots(1, 2, figsize=(9, 5), layout="constrained")
axes[0].imshow(colours[classes], extent=extent)
axes[0].set_title("safe, caution, hazard, unknown; path")
drawn = axes[1].imshow(p_hazard, cmap="magma_r", vmin=0, vmax=1, extent=extent)
axes[1].set_title("probability of a hazard")
figure.colorbar(drawn, ax=axes[1], shrink=0.8)
for ax in axes:
    for line in lines:
        ax.plot(line[:, 0], line[:, 1], color="black", linewidth=2)
    ax.set(xlabel="x [m]", ylabel="y [m]")
