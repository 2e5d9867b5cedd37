"""
Terrain and its standard deviation
==================================

Every cell of an elevation model has a standard deviation. It grows with range and beside occlusions.
"""

# %%
# One pair is enough for an elevation model.

import itertools

import matplotlib.pyplot as plt
import numpy as np

import rille

small = {"frames": 1, "image_width": 285, "image_height": 260, "focal_length": 300.0}
pair = rille.open("mockup-short", mockup=small)[0]
dem = rille.terrain(rille.match(pair.left, pair.right), pair, cell_size=0.004)
dem

# %%
# Draw image, elevation and standard deviation. White cells are undefined: nothing is interpolated.

extent = [float(v) for v in (dem.x[0], dem.x[-1], dem.y[-1], dem.y[0])]
figure, axes = plt.subplots(1, 3, figsize=(11, 4), layout="constrained")
axes[0].imshow(pair.left, cmap="gray")
axes[0].set_title("left image")
axes[0].axis("off")
for ax, name, cmap in zip(
    axes[1:], ("elevation", "elevation_std"), ("terrain", "magma"), strict=True
):
    drawn = ax.imshow(1000 * dem[name], cmap=cmap, extent=extent)
    figure.colorbar(drawn, ax=ax, label="mm")
    ax.set(title=name, xlabel="x [m]", ylabel="y [m]")

# %%
# The standard deviation against the distance from the camera: its median, and the middle half of the cells.

ranges = np.hypot(*np.meshgrid(dem.x, dem.y))
edges = np.arange(0.2, 1.1, 0.1)
quartiles = []
for near, far in itertools.pairwise(edges):
    chosen = dem.elevation_std.values[(ranges >= near) & (ranges < far)]
    quartiles.append(np.nanpercentile(1000 * chosen, (25, 50, 75)))
low, middle, high = np.array(quartiles).T

figure, ax = plt.subplots(figsize=(6, 3.5), layout="constrained")
centres = (edges[:-1] + edges[1:]) / 2
ax.fill_between(centres, low, high, alpha=0.3)
ax.plot(centres, middle)
ax.set(xlabel="range [m]", ylabel="standard deviation [mm]")
