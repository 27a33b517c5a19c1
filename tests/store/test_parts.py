"""Records of parts: their names are names of the record, in Python as in files."""

import copy
import pickle

import numpy as np
import pytest

from projservo_cli.records import (
    Calibration,
    CarriedByObject,
    GoalOfIncidences,
    InputError,
    Observation,
    Plan,
    Trace,
    changed,
    flat_fields,
)
from projservo_cli.results import MotionPlan
from projservo_cli.store.run_file import Result, Run, load, save
from tests.fake_records import fake


@pytest.mark.parametrize("kind", [Calibration, Plan, Trace])
def test_names_of_parts_are_names_of_the_record_and_of_no_other_part(kind):
    record, names = fake(kind), [field.name for field in flat_fields(kind)]
    assert len(set(names)) == len(names) > 50
    assert {*names} <= {*dir(record)}
    for name in names:
        getattr(record, name)
    assert not hasattr(record, "unknown")


def test_what_an_absent_part_has_is_none_or_its_default():
    plan = fake(Plan)
    assert (plan.carried, plan.object_name, plan.s_carried, plan.incidences) == ((), None, None, ())


@pytest.mark.parametrize(
    "again", [copy.copy, copy.deepcopy, lambda record: pickle.loads(pickle.dumps(record))]
)
@pytest.mark.parametrize("kind", [Calibration, Plan, Trace])
def test_records_of_parts_are_copied_and_pickled(kind, again):
    record = fake(kind)
    other = again(record)
    for field in flat_fields(kind):
        np.testing.assert_equal(getattr(other, field.name), getattr(record, field.name), err_msg=field.name)


def test_fields_are_changed_wherever_they_are():
    plan = MotionPlan.of(fake(Plan), asked=("here", "there"))
    other = changed(plan, reason="else", tau=0.25, theta_p=0.5)
    assert (other.reason, other.partition.tau, other.theta_p, other.theta_r) == (
        "else",
        0.25,
        0.5,
        plan.theta_r,
    )
    assert (type(other), other.asked, plan.tau) == (MotionPlan, ("here", "there"), fake(Plan).tau)
    with pytest.raises(TypeError, match="nothing"):
        changed(plan, nothing=1)


def test_a_calibration_by_the_retired_method_is_refused_with_a_remedy(tmp_path):
    records = {
        "observation": fake(Observation),
        "calibration": changed(fake(Calibration), method="closed_form"),
    }
    save(Run(tmp_path / "run.h5", "", {"calibrate": Result("", "", {}, {}, records)}))
    with pytest.raises(InputError, match=r"by the method closed_form, which is retired.*make it again"):
        load(tmp_path)


def test_a_part_comes_back_from_a_file_where_it_was(tmp_path):
    goal = GoalOfIncidences(incidences=("pin on hole",), free_dof=3, s_goal=np.zeros((2, 5, 2)))
    save(
        Run(
            tmp_path / "run.h5",
            "",
            {"plan": Result("", "", {}, {}, {"": changed(fake(Plan), open_goal=goal)})},
        )
    )
    back = load(tmp_path).plan
    assert (back.open_goal.incidences, back.free_dof) == (("pin on hole",), 3)
    assert (back.search, back.carried) == (None, ())


def test_parts_of_a_list_come_back_from_a_file_each_of_its_own_size(tmp_path):
    objects = tuple(
        fake(CarriedByObject, k, {"object_marker": 4 + k}, object_name=name)
        for k, name in enumerate(("block", "box", "lid"))
    )
    plan = changed(fake(Plan), carried=objects)
    assert (plan.object_name, changed(plan, object_name="other").carried[0].object_name) == ("block", "other")
    save(Run(tmp_path / "run.h5", "", {"plan": Result("", "", {}, {}, {"": plan})}))
    back = load(tmp_path).plan
    assert [one.object_name for one in back.carried] == ["block", "box", "lid"]
    for one, other in zip(back.carried, objects, strict=True):
        np.testing.assert_array_equal(one.s_object, other.s_object)
