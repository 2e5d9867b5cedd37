"""
A misaligned rig
================

The right camera of a stereo rig is knocked. Rectification with the old calibration no longer brings matches to one row.
Rille matches in two dimensions, measures the row offsets and repairs the relative orientation.
"""

# %%
# Open the same sequence twice: as it is, and with the right image shifted by three rows and turned by half a degree.

import matplotlib.pyplot as plt
import numpy as np

import rille

small = {"frames": 1, "image_width": 285, "image_height": 260, "focal_length": 300.0}
knocks = {"as calibrated": {}, "knocked": {"rows": 3.0, "roll_deg": 0.5}}
pairs = {
    name: rille.open("mockup-short", mockup=small, misalign=knock)[0]
    for name, knock in knocks.items()
}

# %%
# Match both. The row disparity of the knocked pair differs by three rows and by a gradient, which is the roll.

matches = {name: rille.match(pair.left, pair.right) for name, pair in pairs.items()}

figure, axes = plt.subplots(2, 2, figsize=(8, 7), layout="constrained")
for row, (name, found) in zip(axes, matches.items(), strict=True):
    for ax, direction, limits in zip(
        row, ("column", "row"), ((-80, 20), (-12, 12)), strict=True
    ):
        drawn = ax.imshow(
            found[f"{direction}_disparity"], cmap="viridis", vmin=limits[0], vmax=limits[1]
        )
        figure.colorbar(drawn, ax=ax, label="px", shrink=0.8)
        ax.set_title(f"{name}: {direction} disparity")
        ax.axis("off")

# %%
# Reconstruct both. ``terrain`` repairs the knocked rig from its matches, so both elevation models agree.

models = {
    name: rille.terrain(matches[name], pair, cell_size=0.004)
    for name, pair in pairs.items()
}
first, second = models.values()
x = np.intersect1d(first.x.round(6), second.x.round(6))
y = np.intersect1d(first.y.round(6), second.y.round(6))[::-1]


def on_common_cells(dem):
    """Elevations of the cells that both models cover."""
    rows, cols = np.isin(dem.y.round(6), y), np.isin(dem.x.round(6), x)
    return dem.elevation.values[rows][:, cols]


difference = 1000 * (on_common_cells(second) - on_common_cells(first))
print(
    f"median difference {np.nanmedian(difference):.2f} mm, NMAD {1.4826 * np.nanmedian(abs(difference)):.2f} mm"
)

figure, ax = plt.subplots(figsize=(6, 5), layout="constrained")
drawn = ax.imshow(
    difference, cmap="RdBu", vmin=-5, vmax=5, extent=(x[0], x[-1], y[-1], y[0])
)
figure.colorbar(drawn, label="knocked minus calibrated [mm]")
ax.set(xlabel="x [m]", ylabel="y [m]", title="Difference of the elevations")
