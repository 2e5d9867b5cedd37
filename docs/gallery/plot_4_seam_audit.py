"""
Seam audit
==========

Overlapping elevation models must agree. The seam audit fits a bias and a tilt to the difference of each
overlapping pair of models, and compares them with what the standard deviations permit. It needs no truth.
"""

# %%
# Reconstruct nine frames and read the audit from the report.

import matplotlib.pyplot as plt
import numpy as np

import rille

small = {"frames": 9, "image_width": 285, "image_height": 260, "focal_length": 300.0}
run = rille.reconstruct(
    rille.open("mockup-short", mockup=small),
    executor="inline",
    locus={"cell_size": 0.004},
    keyframes={"stride": 2},
    crosscheck={"enabled": False},
)
seams = run.report["seams"]["seams"]
for seam in seams:
    tilt = 1000 * np.hypot(*seam["tilt"])
    print(
        f"models {seam['other']} and {seam['pair']}: {seam['cells']} cells, bias {1000 * seam['bias']:+.2f} mm, "
        f"tilt {tilt:.1f} mm/m, noise of a cell {1000 * seam['noise']:.2f} mm"
    )

# %%
# A bar is the RMS of bias and tilt over the ground that two models share. The mark is the difference of one cell that
# the models' standard deviations lead one to expect. A model above twice that mark, and clearly above its noise,
# contradicts its neighbours, and the report names it.

labels = [f"{seam['other']}-{seam['pair']}" for seam in seams]
figure, ax = plt.subplots(figsize=(8, 3.5), layout="constrained")
ax.bar(labels, [1000 * seam["systematic"] for seam in seams], label="bias and tilt, RMS")
ax.plot(
    labels,
    [1000 * seam["expected"] for seam in seams],
    "k_",
    markersize=18,
    label="expected difference of a cell",
)
ax.set(xlabel="pair of models", ylabel="[mm]")
ax.legend()
