"""Sequences by name: what is known, and what the near miss was."""

from __future__ import annotations

import numpy as np
import pytest
from folders import write_lines, write_sequence
from raising import raises

from rille.datasets import registry
from rille.datasets.registry import MANIFESTS, catalogue, open_sequence
from rille.pipeline.flow import config as configuration
from rille.pipeline.runs.options import Options
from rille.pipeline.runs.session import settings_of_run


def test_every_listed_name_opens():
    names = [name for name, _ in catalogue()]
    assert names[:5] == ["mockup", "mockup-short", "mockup-loop", "devon_island", "nasa_k10"]
    full, short = open_sequence("mockup"), open_sequence("mockup-short")
    assert (full.frames, short.frames) == (40, 9)
    assert full.defaults == {
        "keyframes.rule": "stride",
        "keyframes.stride": 4,
        "locus.cell_size": 0.001,
        "intrinsics.prior": 1e-5,
    }
    configuration.build(configuration.expand(full.defaults))
    assert full.evaluation_window == (-0.3, 0.4, 0.3, 0.7)
    assert (full.rig.left.width, full.rig.left.height) == (570, 520)
    assert full.vehicle is not None
    assert all(words for _, words in catalogue())


def test_windows_of_successive_basic_pairs_overlap_by_more_than_half():
    from rille.stages.geometry.geometry import level_rotation

    s = open_sequence("mockup")
    a, b = s.truth[0], s.truth[int(s.defaults["keyframes.stride"])]
    dx, dy, _ = level_rotation(a.rotation[2]) @ a.rotation.T @ (b.translation - a.translation)
    x0, y0, x1, y1 = s.evaluation_window
    assert 0.53 < (1 - abs(dx) / (x1 - x0)) * (1 - abs(dy) / (y1 - y0)) < 0.7


def test_overrides_reach_the_mockup_alone():
    s = open_sequence("mockup-short", {"mockup": {"seed": 5, "frames": 4}})
    assert s.frames == 4
    assert s.parameters["mockup"].seed == 5
    assert s.parameters["mockup"].bed_width == 1.2
    with raises("RIL-281"):
        open_sequence("mockup", {"kitti": {}})


def test_folders_have_no_overrides(tmp_path):
    with raises("RIL-281"):
        open_sequence(str(tmp_path), {"mockup": {"seed": 1}})


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({"sed": 1}, ("RIL-280", "'mockup.sed'", "mean mockup.seed?")),
        ({"qqqq": 1}, ("RIL-280", "'mockup.qqqq'", "attitude_noise_deg")),
        ({"seed": -1}, ("RIL-280", "mockup.seed")),
        ({"noise": "loud"}, ("RIL-280", "mockup.noise", "'loud'")),
        ({"noise": float("inf")}, ("RIL-280", "mockup.noise")),
    ],
)
def test_bad_overrides_say_what_is_permitted(values, expected):
    with raises(*expected):
        open_sequence("mockup", {"mockup": values})


@pytest.mark.parametrize("name", ["mokup", "mockup_short", "Mockup"])
def test_near_misses_are_suggested(name):
    for overrides in ({}, {"mockup": {"seed": 1}}):
        with raises("RIL-276", "mean mockup"):
            open_sequence(name, overrides)


def test_an_unknown_folder_or_file_says_how_to_open_it(tmp_path):
    folder = tmp_path / "field"
    folder.mkdir()
    with raises("RIL-277", f"`rille init {folder}`", "`rille datasets list`"):
        open_sequence(str(folder))
    (tmp_path / "field.rille.toml").touch()
    with raises("RIL-277", f"give its manifest, {folder}.rille.toml"):
        open_sequence(str(folder))
    run = tmp_path / "runs" / "field"
    run.mkdir(parents=True)
    (run / "report.json").touch()
    with raises("RIL-277", "rille.open_run reads it"):
        open_sequence(str(run))
    bags = tmp_path / "bags"
    (bags / "second").mkdir(parents=True)
    (bags / "second" / "metadata.yaml").write_text("rosbag2_bagfile_information: {}\n")
    with raises("RIL-277", f"give a bag in it, e.g. {bags / 'second'}"):
        open_sequence(str(bags))
    (tmp_path / "link").symlink_to(tmp_path / "gone")
    with raises("RIL-276", f"a link to {tmp_path / 'gone'}, which is missing"):
        open_sequence(str(tmp_path / "link"))
    with raises("RIL-276", "no file 'field.toml'"):
        open_sequence("field.toml")
    with raises("RIL-992", "field.rille.txt is no sequence"):
        (tmp_path / "field.rille.txt").touch()
        open_sequence(str(tmp_path / "field.rille.txt"))
    with raises("RIL-276", "'no/such/folder'"):
        open_sequence("no/such/folder")
    for name in ("a\0b", "x" * 5000, "\ud800", "x" * 5000 + ":1"):
        with raises("RIL-276", "no sequence"):
            open_sequence(name)
    with raises("RIL-276", "'~nobody-of-that-name/folder'"):
        open_sequence("~nobody-of-that-name/folder")
    with raises("RIL-276", "'nasa-k10'", "mean nasa_k10?"):
        open_sequence("nasa-k10")


def test_a_manifest_or_the_folder_that_holds_it(tmp_path):
    path = write_sequence(tmp_path / "rover")
    assert open_sequence(str(path)).name == open_sequence(str(path.parent)).name == "rover"
    upper = path.rename(path.parent / "MANIFEST.TOML")
    assert open_sequence(str(upper)).frames == 3
    upper.rename(path.parent / "manifest.toml")
    assert open_sequence(str(path.parent)).frames == 3
    for name in ("._a", "a", "b"):
        (path.parent / f"{name}.rille.toml").write_bytes((path.parent / "manifest.toml").read_bytes())
        if name == "a":  # beside it what macOS adds to archives
            assert open_sequence(str(path.parent)).frames == 3
    with raises("RIL-279", "a.rille.toml", "b.rille.toml"):
        open_sequence(str(path.parent))


def test_a_manifest_goes_before_the_layout_of_its_folder(tmp_path):
    path = write_sequence(tmp_path, head='name = "chosen"')
    write_lines(tmp_path / "calib.txt", ["60 0 31.5 0 0 60 23.5 0 0 0 1 0", "60 0 31.5 -12 0 60 23.5 0 0 0 1 0"])
    assert open_sequence(str(tmp_path)).rig.baseline == pytest.approx(0.1)
    path.unlink()
    assert open_sequence(str(tmp_path)).rig.baseline == pytest.approx(0.2)


def test_image_folders_without_calibration_are_sent_to_init(tmp_path):
    write_sequence(tmp_path).unlink()
    with raises("RIL-278", "calib.txt"):
        open_sequence(str(tmp_path))


def test_misalignment_is_for_any_sequence(tmp_path, materialise):
    path = str(write_sequence(tmp_path))
    plain, moved = open_sequence(path), open_sequence(path, {"misalign": {"rows": 3.0}})
    assert moved.rig.to_dict() == plain.rig.to_dict()
    assert moved.image(0, "left") == plain.image(0, "left")
    valid = materialise(moved.image(0, "right"))["valid"]
    assert not valid.all()
    assert valid.any()
    assert open_sequence("mockup-short", {"misalign": {"rows": 3.0}, "mockup": {"frames": 2}}).frames == 2
    with raises("RIL-280", "'misalign.row'", "mean misalign.rows?"):
        open_sequence(path, {"misalign": {"row": 3.0}})
    with raises("RIL-281"):
        open_sequence(path, {"misalign": {"rows": 3.0}, "mockup": {}})


def test_manifests_of_the_program_need_their_data(monkeypatch):
    monkeypatch.delenv("RILLE_DATA", raising=False)
    for name in MANIFESTS:
        with raises("RIL-214", "RILLE_DATA"):
            open_sequence(name)


@pytest.mark.data
def test_devon_island(data_dir):
    s = open_sequence("devon_island")
    assert (s.name, s.frames, s.frame_names[0]) == ("devon_island", 10, "048978")
    assert s.rig.baseline == pytest.approx(226.746 / 968.999694824)
    assert (s.rig.left.fx, s.rig.left.cx, s.rig.left.width) == (968.999694824, 635.139038086, 1280)
    assert s.lenses is None
    assert not s.warnings


@pytest.mark.data
def test_nasa_k10_as_it_was_calibrated(data_dir):
    """Rows of the two cameras differ by 15 px far away, which the rig says too."""
    s = open_sequence("nasa_k10")
    assert (s.name, s.frames, s.rig.left.width, s.rig.left.height) == ("nasa_k10", 1, 1024, 768)
    assert s.lenses is not None
    assert s.lenses["left"].coefficients[0] == pytest.approx(-0.331998556852341)
    assert s.rig.baseline == pytest.approx(0.1058, abs=2e-4)
    far = np.array([0.0, 0.0, 50.0])
    rows = [s.rig.left.project(far)[1], s.rig.right.project(s.rig.T_right_left.apply(far))[1]]
    assert rows[1] - rows[0] == pytest.approx(-15, abs=4)


@pytest.mark.data
def test_up_of_the_calibrations_frame_is_turned_into_the_cameras(data_dir, tmp_path):
    """The K10 cameras are calibrated in the rover's frame, z down: the third row of R (camera to rover) is down."""
    path = tmp_path / "k10.toml"
    path.write_text(
        f'root = "{data_dir}/nasa_k10"\n[images]\nleft = "left4.png"\nright = "right4.png"\n'
        '[cameras]\nleft = "black_left.tsai"\nright = "black_right.tsai"\n[world]\nup = [0, 0, -1]\n'
    )
    s = open_sequence(str(path))
    assert s.up is not None
    assert s.up[0] == pytest.approx((-0.0699, -0.9261, -0.3707), abs=2e-4)


@pytest.mark.data
@pytest.mark.parametrize("name", list(MANIFESTS))
def test_defaults_of_the_programs_manifests_are_parameters(data_dir, name):
    configuration.build(configuration.expand(open_sequence(name).defaults))


@pytest.mark.parametrize(
    ("name", "step"), [("left.mp4", "ffmpeg"), ("drive.svo2", "ZED SDK"), ("left.npy", "cv2.imwrite")]
)
def test_a_file_that_is_no_sequence_says_what_to_do_with_it(tmp_path, name, step):
    (tmp_path / name).write_bytes(b"x")
    with raises("RIL-992", step):
        open_sequence(str(tmp_path / name))


@pytest.mark.parametrize("name", ["left.png", "times.txt"])
def test_a_file_of_a_sequence_is_not_called_unknown(tmp_path, name):
    (tmp_path / name).write_bytes(b"x")
    with raises("RIL-992", "give the folder") as caught:
        open_sequence(str(tmp_path / name))
    assert "neither" not in str(caught.value)


def test_a_folder_of_images_that_are_not_read_says_so(tmp_path):
    for side in ("left", "right"):
        (tmp_path / side).mkdir()
        (tmp_path / side / "1.heic").write_bytes(b"x")
    (tmp_path / "calib.txt").write_text("7 0 3 0 0 7 2 0 0 0 1 0\n7 0 3 -1 0 7 2 0 0 0 1 0\n")
    with raises("RIL-171", "1.heic", "convert them"):
        open_sequence(str(tmp_path))


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """A package that adds a layout, in a folder that takes the place of the installed packages'."""
    write_lines(
        tmp_path / "site" / "my_format.py",
        [
            "from rille.datasets.registry import open_sequence",
            "FORMS = (('FOLDER', 'one with a file my.format'),)",
            "def open_layout(path, number, digests):",
            "    return open_sequence(str(path / 'inner')) if (path / 'my.format').is_file() else None",
        ],
    )
    about = tmp_path / "site" / "my_format-1.dist-info"
    write_lines(about / "METADATA", ["Metadata-Version: 2.1", "Name: my_format", "Version: 1"])
    write_lines(about / "entry_points.txt", ["[rille.formats]", "mine = my_format"])
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    registry.layouts.cache_clear()
    yield tmp_path / "site"
    registry.layouts.cache_clear()


def test_an_installed_package_adds_a_layout_and_the_current_folder_none(installed, tmp_path, monkeypatch):
    write_sequence(tmp_path / "field" / "inner", head='name = "mine"')
    write_lines(tmp_path / "field" / "my.format", [""])
    monkeypatch.chdir(installed)
    with raises("RIL-277"):
        open_sequence(str(tmp_path / "field"))
    registry.layouts.cache_clear()
    monkeypatch.setattr(registry.sysconfig, "get_path", lambda name: str(installed))
    assert open_sequence(str(tmp_path / "field")).name == "mine"
    assert ("FOLDER", "one with a file my.format") in catalogue()


@pytest.mark.parametrize("folder", ["seq", "baseline"])
def test_another_warning_about_the_place_of_the_baseline_is_none_about_the_baseline(tmp_path, folder):
    """The baseline is long, and a principal point is off."""
    figures = "{{ fx = {}, cx = 31.5, cy = {} }}"
    cameras = f"[cameras]\nleft = {figures.format(60.0, 35.5)}\nright = {figures.format(60.0, 23.5)}\n"
    path = write_sequence(
        tmp_path / folder, cameras=cameras, rig="[rig]\nunit = 1.0\nT_right_left = [[1,0,0,-7],[0,1,0,0],[0,0,1,0]]\n"
    )
    lines = settings_of_run(str(path), Options(), warn=lambda _: None).sequence.warnings
    assert {line[:7] for line in lines} == {"RIL-689", "RIL-641"}
