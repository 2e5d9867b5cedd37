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
# Match both. The cameras are turned inward, so rows differ even with the exact calibration.
# The knock adds three rows, and a gradient along the columns, which is the roll.

matches = {name: rille.match(pair.left, pair.right) for name, pair in pairs.items()}
rows = {name: found.row_disparity for name, found in matches.items()}
rows["added by the knock"] = rows["knocked"] - rows["as calibrated"]

figure, axes = plt.subplots(1, 3, figsize=(11, 3.6), layout="constrained")
for ax, (name, values) in zip(axes, rows.items(), strict=True):
    low, high = (0, 6) if name.startswith("added") else (-12, 15)
    drawn = ax.imshow(values, cmap="viridis", vmin=low, vmax=high)
    figure.colorbar(drawn, ax=ax, label="row disparity [px]", shrink=0.7)
    ax.set_title(name)
    ax.axis("off")

# %%
# Reconstruct both. ``terrain`` repairs the knocked rig from its matches. A small tilt remains between the two models,
# because one pair determines the relative orientation only so well; a sequence pools all its pairs.

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
