"""The drive of the report."""

from types import SimpleNamespace

import numpy as np

from rille.pipeline.report.driving import tracks
from rille.pipeline.report.words import metres, number
from rille.stages.geometry.geometry import RigidTransform, rotation_exp


def test_tracks_of_a_drive_that_lost_frames():
    """A frame without a pose is a gap; the true track is laid on the first frame that has both."""
    poses = [RigidTransform(rotation_exp([0.0, 0.0, 0.1 * k]), np.array([0.1 * k, 0.0, 0.0])) for k in range(4)]
    T_vehicle_left = RigidTransform(rotation_exp([0.2, 0.0, 0.0]), np.array([0.0, 0.1, 0.2]))
    given = np.array([pose.matrix34 for pose in poses])
    given[1] = np.nan
    elsewhere = RigidTransform(rotation_exp([0.0, 0.0, 0.7]), np.array([1.0, 2.0, 0.0]))
    view = SimpleNamespace(
        sequence=SimpleNamespace(
            simulation=SimpleNamespace(T_vehicle_left=T_vehicle_left),
            truth=[None, *(elsewhere @ pose for pose in poses[1:])],
        ),
        frames=range(4),
        products=SimpleNamespace(trajectory=object()),
        bundle=lambda _: {"poses": given},
    )
    found, truth = tracks(SimpleNamespace(view=view))
    wheels = np.array([(pose @ T_vehicle_left.inverse()).translation[:2] for pose in poses])
    assert np.isnan(found[1]).all()
    assert np.isnan(truth[0]).all()
    np.testing.assert_allclose(found[[0, 2, 3]], wheels[[0, 2, 3]], atol=1e-12)
    np.testing.assert_allclose(truth[1:], wheels[1:], atol=1e-12)


def test_a_gap_is_a_dash_in_words():
    assert [number(np.nan), metres(np.nan), metres(None)] == ["–"] * 3
