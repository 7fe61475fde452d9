"""A record tells every run behind its weights: the last of each task by name, those before them in their order."""

import pytest
from nlos_models.checkpoint import CheckpointRecord
from nlos_models.recipe import SIMULATION_ONLY, Recipe

RIG = ("paper-rig", "0123")


def _run(task: str, seed: int, **changes: object) -> Recipe:
    facts = {"task": task, "seed": seed, "objects": 8, "held_out": 2, "epochs": 1, "batch": 2, "learning_rate": 1e-3}
    return Recipe.model_validate(facts | changes)


VAES = [_run("vae", seed) for seed in range(3)]
COMPRESSORS = [_run("compressor", seed) for seed in range(3)]
TRANSFERS = [_run("transfer", seed) for seed in range(2)]
JOINT = _run("compressor", 9, steps="two-then-joint", image_weight=1.0)


@pytest.mark.parametrize(
    ("runs", "named", "earlier"),
    [
        (VAES[:1], (VAES[0], None, None), []),
        (VAES, (VAES[2], None, None), VAES[:2]),
        ([VAES[0], COMPRESSORS[0]], (VAES[0], COMPRESSORS[0], None), []),
        ([VAES[0], *COMPRESSORS[:2]], (VAES[0], COMPRESSORS[1], None), COMPRESSORS[:1]),
        ([VAES[0], COMPRESSORS[0], JOINT], (VAES[0], JOINT, None), COMPRESSORS[:1]),
        (
            [VAES[0], COMPRESSORS[0], VAES[1], COMPRESSORS[1]],
            (VAES[1], COMPRESSORS[1], None),
            [VAES[0], COMPRESSORS[0]],
        ),
        ([VAES[0], COMPRESSORS[0], *TRANSFERS], (VAES[0], COMPRESSORS[0], TRANSFERS[1]), TRANSFERS[:1]),
        ([VAES[0], COMPRESSORS[0], TRANSFERS[0], JOINT], (VAES[0], JOINT, None), [COMPRESSORS[0], TRANSFERS[0]]),
    ],
)
def test_the_last_run_of_each_task_is_named_and_none_is_forgotten(
    runs: list[Recipe], named: tuple[Recipe | None, ...], earlier: list[Recipe]
) -> None:
    record = CheckpointRecord.of(runs, RIG, "difference maps")
    assert (record.vae_recipe, record.compressor_recipe, record.transfer_recipe) == named
    assert record.earlier == earlier
    assert sorted(run.model_dump_json() for run in record.runs) == sorted(run.model_dump_json() for run in runs)
    assert (record.rig_name, record.rig_checksum, record.input) == (*RIG, "difference maps")
    assert CheckpointRecord.model_validate_json(record.model_dump_json()) == record


def test_a_vae_was_made_by_its_own_runs_and_by_those_that_moved_its_decoder() -> None:
    record = CheckpointRecord.of([*VAES[:2], COMPRESSORS[0], JOINT, TRANSFERS[0]], RIG)
    assert record.vae_runs == [VAES[0], VAES[1], JOINT]


def test_a_record_in_colour_says_that_it_is_simulation_only_and_one_of_depth_says_nothing() -> None:
    runs = [_run("vae", 0, colour=True), _run("compressor", 0, colour=True)]
    for some in (runs[:1], runs[1:], runs):
        record = CheckpointRecord.of(some, RIG)
        assert (record.colour, record.note) == (True, SIMULATION_ONLY)
        assert CheckpointRecord.model_validate_json(record.model_dump_json()) == record
        assert CheckpointRecord.model_validate(record.model_dump(exclude={"note"})) == record
    depth = CheckpointRecord.of([VAES[0], COMPRESSORS[0]], RIG)
    assert (depth.colour, depth.note) == (False, "")


def test_a_record_of_before_earlier_runs_were_told_is_read() -> None:
    facts = CheckpointRecord.of(VAES[:1], RIG).model_dump(mode="json")
    del facts["earlier"]
    assert CheckpointRecord.model_validate(facts).runs == VAES[:1]
