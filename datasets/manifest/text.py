"""A commented manifest of what was found in a folder, with what is missing marked where it belongs."""

from __future__ import annotations

from collections.abc import Iterable

import tomli_w

from rille.datasets.inspection import Findings, FoundCalibration, FoundImages
from rille.datasets.manifest.rig import LONGEST_BASELINE
from rille.datasets.text.count import count
from rille.datasets.text.names import derived_name

NEEDED = "NEEDED"
"""Marks a line that must be filled in before the manifest opens."""

HEAD = """# A stereo sequence for Rille, written by `rille init` from what the folder holds. Text after # is a comment.
# Lines marked {needed} must be filled in; the others can stay as they are.
# Lengths are metres. Camera frames: x right, y down, z forward. T_a_b maps coordinates of frame b to frame a.
"""


def manifest_text(found: Findings, root: str) -> str:
    """Manifest as TOML; ``root`` is the folder relative to the manifest (or absolute)."""
    parts = [
        HEAD.format(needed=NEEDED) + "\n" + _pairs(name=derived_name(found.folder.resolve().name), root=root),
        _images(found),
        _cameras(found),
        _rig(found),
        _times(found),
        _world(),
        _poses(found),
        _sensors(found),
        _rest(),
    ]
    return "\n".join(parts)


def needs(text: str) -> list[str]:
    """What a manifest's text marks as needed, one line each."""
    return [line.split(NEEDED, 1)[1].lstrip(": ") for line in text.splitlines() if f"# {NEEDED}:" in line]


def _pairs(**values: object) -> str:
    return tomli_w.dumps(values)


def _images(found: Findings) -> str:
    views = found.views
    lines = [f"[images]\n# {views.why}."]
    if views.sizes is None:
        lines.append(f"# {NEEDED}: correct the patterns: {views.trouble}")
    else:
        lines.append(f"# They make {pair_words(views)} of {size_words(views.sizes)} pixels.")
    lines.append(_pairs(left=views.left, right=views.right).rstrip())
    if views.lines:
        lines += [f"# {line}" for line in views.lines] + ['pair = "nearest"', "# tolerance = 0.01  # s"]
    else:
        lines.append('# pair = "auto"  # or "name", "number", "nearest" (time stamps in the names), "order"')
    return "\n".join(lines) + "\n"


def pair_words(views: FoundImages) -> str:
    """How many pairs there are, and whether some lack an image."""
    gaps, words = views.absent, count(views.pairs, "pair")
    more = f" and {len(gaps) - 1} more" if len(gaps) > 1 else ""
    return f"{words} ({gaps[0]}{more})" if gaps else words


def size_words(sizes: Iterable[tuple[int, int] | None]) -> str:
    """Sizes that are known, each once."""
    return " and ".join(dict.fromkeys(f"{size[0]} x {size[1]}" for size in sizes if size is not None))


def _cameras(found: Findings) -> str:
    calibration, lines = found.calibration, ["[cameras]"]
    lines += [f"# Not readable: {line}" for line in found.unread]
    if calibration is None:
        lines.append(f"# {NEEDED}: no calibration was found; give a file, two files, or figures in pixels")
        lines.append(
            '# file = "calibration.yaml"  # OpenCV, ROS, Kalibr, ORB-SLAM, EuRoC, COLMAP; `rille calibrate` makes one'
        )
        lines += [f"# {key}" for key in ("fx = 700.0", "fy = 700.0", "cx = 320.0", "cy = 240.0")]
        lines.append('# model = "radtan"  # k1 k2 p1 p2 [k3]; none, rational, fisheye')
        lines.append("# distortion = [0.0, 0.0, 0.0, 0.0]")
        return "\n".join(lines) + "\n"
    return "\n".join([*lines, *_calibration_lines(calibration, found)]) + "\n"


def _calibration_lines(calibration: FoundCalibration, found: Findings) -> list[str]:
    lines = []
    if not calibration.suits(found.views.sizes):
        lines.append(
            f"# {NEEDED}: this calibration is of {size_words(calibration.sizes)} pixels; give one of the images' size"
        )
    if len(calibration.files) == 2:
        lines.append(_pairs(left=calibration.files[0], right=calibration.files[1]).rstrip())
    else:
        if calibration.cameras == 1:
            lines.append(
                "# One camera in the file: it is taken for both. Give left = and right = files if they differ."
            )
        lines.append(_pairs(file=calibration.files[0]).rstrip())
        if calibration.names is not None:
            lines.append("# Of its cameras these two, left and right:")
            lines.append(f"names = {list(calibration.names)}".replace("'", '"'))
    if found.others:
        lines.append(f"# Other calibrations here: {', '.join(found.others)}")
    return lines


def _rig(found: Findings) -> str:
    lines, baseline = ["[rig]"], found.calibration.baseline if found.calibration else None
    if baseline is None:
        lines.append(f"# {NEEDED}: nothing says where the right camera stands; give the baseline (m), or T_right_left")
        lines.append("# baseline = 0.1")
        lines.append("# T_right_left = [[1, 0, 0, -0.1], [0, 1, 0, 0], [0, 0, 1, 0]]  # x_right = R x_left + t")
    elif baseline > LONGEST_BASELINE:
        lines.append(
            f"# {NEEDED}: the baseline of the calibration is {baseline:.6g}, too long for metres; if it is mm, say so"
        )
        lines.append("# unit = 0.001")
    else:
        lines.append(
            f"# From the calibration: baseline {baseline:.6g} m. If that is no length in metres, give the unit:"
        )
        lines.append("# unit = 0.001")
    return "\n".join(lines) + "\n"


def _times(found: Findings) -> str:
    files = found.tables.get("times", [])
    if files:
        others = f"# Others: {', '.join(files[1:])}\n" if files[1:] else ""
        return f"[times]\n{others}{_pairs(file=files[0])}"
    if found.views.stamped:
        return "[times]\n# The image names are time stamps.\nnames = true\n"
    return (
        "# [times]  # optional: one of\n"
        '# file = "times.txt"  # one a pair, or lines of time and file name\n'
        "# names = true  # the image names are time stamps\n"
        "# rate_hz = 10.0\n"
    )


def _world() -> str:
    return """[world]
# Where up is comes from the ground that the images show, unless it is known:
# pitch_deg = 20.0     # downward pitch of the left camera over the ground, roll 0
# up = [0, 0, 1]       # direction of up in the reference frame of the calibration files
"""


def _poses(found: Findings) -> str:
    files, alone = found.tables.get("truth", []), found.tables.get("positions", [])
    if not files and alone:
        others = f"# Other tables of positions: {', '.join(alone[1:])}\n" if alone[1:] else ""
        return (
            "[truth]\n# Positions alone, only to judge the result: compared after a rigid fit in the plane, with a "
            f"constant offset in time found.\n{others}{_pairs(file=alone[0])}"
            '# columns = { time = "NAME", x = "NAME", y = "NAME" }  # where names are not clear; x, y: the ground\n'
            '# source = "where they come from, in words"\n'
        )
    if not files:
        return (
            "# [truth]  # optional: true poses, only to judge the result\n"
            '# file = "poses.txt"  # KITTI 3 x 4, TUM, EuRoC; or a table time,x,y\n'
            "# T_body_left = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]  # where they are poses of another body\n"
        )
    others = f"# Other tables of poses: {', '.join(files[1:])}\n" if files[1:] else ""
    return (
        "[truth]\n# Taken for poses of the left camera, only to judge the result. If they are those of another body, "
        f"give T_body_left.\n{others}{_pairs(file=files[0])}"
        "# T_body_left = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]\n"
        '# source = "where they come from, in words"\n'
    )


def _sensors(found: Findings) -> str:
    lines = []
    for kind, key in (("attitude", "T_body_left"), ("imu", "T_imu_left")):
        files = found.tables.get(kind, [])
        if files:
            lines.append(f"# [{kind}]  # found, and used once it is known how the sensor stands to the left camera")
            lines += [
                f"# {_pairs(file=files[0]).rstrip()}",
                f"# {key} = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]",
                "",
            ]
    return "\n".join(lines)


def _rest() -> str:
    return """# [vehicle]  # its limits decide what is hazardous; a small rover of 60 kg by default
# wheel_diameter = 0.30
# max_step = 0.12

[defaults]
# Parameters that suit this sequence, as for --set, e.g. cells of 5 cm:
# locus.cell_size = 0.05
"""
