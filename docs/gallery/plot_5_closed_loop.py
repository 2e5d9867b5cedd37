"""
Closed loop
===========

A simulated rover drives to a goal: it stops, matches one pair, merges the terrain, plans and drives a leg. The
simulator alone knows the true poses; the rover knows its images, an inclinometer and its wheels.
"""

# %%
# ``mockup-loop`` is driven, not reconstructed; the function is the same.

import matplotlib.pyplot as plt
import numpy as np
import rasterio

import rille

run = rille.reconstruct(
    "mockup-loop",
    executor="inline",
    drive={"goal": (0.1, 0.5)},
)
print(run.report["verdict"])

# %%
# The map that the rover made on its way, what it took for a hazard, and where it drove.

with rasterio.open(run.folder / "risk.tif") as source:
    risk, box = source.read(1), source.bounds
extent = (box.left, box.right, box.bottom, box.top)
position = run.trajectory.position
colours = np.array(
    [(0.45, 0.72, 0.42), (0.96, 0.80, 0.32), (0.80, 0.25, 0.20), (0.88, 0.88, 0.88)]
)

figure, axes = plt.subplots(1, 2, figsize=(9, 5), layout="constrained")
terrain = run.terrain
x, y = terrain.x.values, terrain.y.values
drawn = axes[0].imshow(
    1000 * terrain.elevation, cmap="terrain", extent=(x[0], x[-1], y[-1], y[0])
)
figure.colorbar(drawn, ax=axes[0], label="elevation [mm]", shrink=0.8)
axes[1].imshow(colours[risk], extent=extent)
axes[1].set_title("safe, caution, hazard, unknown")
for ax in axes:
    ax.plot(position.sel(axis="x"), position.sel(axis="y"), "k.-", label="left camera")
    ax.plot(0.1, 0.5, "*", color="tab:blue", markersize=14, label="goal")
    ax.set(xlabel="x [m]", ylabel="y [m]")
axes[1].legend(loc="lower left")
