import pytest
from nlos_calibration.rig import DeviceConstants, LidarPose, ObjectBox, Occluder, PinholeRecord, Rig, load_rig
from nlos_calibration.rig_check import rig_difference

PAPER = load_rig("paper-rig")


def changed(**fields: object) -> Rig:
    return PAPER.model_copy(update=fields)


def test_what_a_calibration_may_err_by_is_no_difference() -> None:
    measured = LidarPose(distance_m=0.2008, yaw_deg=44.9, pitch_deg=0.1)
    assert rig_difference(PAPER, PAPER) == ()
    assert rig_difference(changed(name="measured", lidar=measured), PAPER) == ()


def test_the_same_field_at_another_size_is_no_difference() -> None:
    small = PinholeRecord.model_validate(vars(PAPER.pinhole.scaled(320, 240)))
    assert rig_difference(changed(intrinsics=small), PAPER) == ()


@pytest.mark.parametrize(
    ("field", "value", "told"),
    [
        ("lidar", LidarPose(distance_m=0.25, yaw_deg=45.0), "the lidar 50 mm farther from the wall"),
        ("lidar", LidarPose(distance_m=0.15, yaw_deg=45.0), "the lidar 50 mm closer to the wall"),
        ("lidar", LidarPose(distance_m=0.2, yaw_deg=30.0), "yaw -15.0 degrees"),
        ("lidar", LidarPose(distance_m=0.2, yaw_deg=45.0, pitch_deg=2.0), "pitch +2.0 degrees"),
        ("occluder", Occluder(x_m=0.25, z_min_m=0.1), "the occluder 50 mm farther along the wall"),
        ("occluder", Occluder(x_m=0.2, z_min_m=0.06), "its gap 40 mm narrower"),
        ("occluder", None, "no occluder"),
        ("intrinsics", PinholeRecord(fx=400.0), "a field of view of 77.3 x 55.0 degrees, not 70.0 x 55.0"),
        ("device", DeviceConstants(receiver_cell_m2=1e-3), "other device constants"),
        (
            "object_box",
            ObjectBox(x_min_m=0.3, x_max_m=0.5, y_min_m=-0.1, y_max_m=0.1, z_near_m=0.1, z_far_m=0.4),
            "another object box",
        ),
    ],
)
def test_a_difference_is_told_with_its_amount(field: str, value: object, told: str) -> None:
    assert rig_difference(changed(**{field: value}), PAPER) == (told,)


def test_an_occluder_where_there_is_none_is_told() -> None:
    assert rig_difference(PAPER, changed(occluder=None)) == ("an occluder",)
