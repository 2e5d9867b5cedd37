"""Tables of steps: they hold what the motions tell, wherever they are cut."""

import numpy as np
import pytest
from motion_scenes import motion, shift, tables
from raising import raises

from rille.stages.core.declare import Bundle, check_outputs
from rille.stages.odometry.steps import Step, step_table_stage, steps_of

MOTIONS = [motion(shift(u), unmatched=lambda x, y, u=u: x + y < 3 * u) for u in (9.0, 9.5, 9.0, 60.0, -42.0, 9.0, 11.0)]


@pytest.mark.parametrize("rows", [1, 2, 3, 7])
def test_tables_hold_the_steps_and_changes_of_their_motions(rows):
    made = tables(MOTIONS, rows)
    for table in made:
        check_outputs(step_table_stage, table)
    steps = steps_of(made)
    for found, given in zip(steps, MOTIONS, strict=True):
        wanted = Step.from_bundle(given)
        np.testing.assert_array_equal(found.blocks, wanted.blocks)
        np.testing.assert_array_equal(found.shift, wanted.shift)
        assert (found.side, found.match_rate) == (wanted.side, wanted.match_rate)
    assert steps[2].change(steps[3]) == pytest.approx(51.0)


def test_no_motion_makes_no_table():
    assert steps_of([]) == []


def test_motions_of_other_images_are_refused():
    small = Bundle({name: array[:-20] for name, array in MOTIONS[0].arrays.items()}, MOTIONS[0].meta)
    with raises("RIL-895"):
        tables([MOTIONS[0], small])
