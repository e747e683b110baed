"""Unit and reference of per-point time are recovered from the values, for every habit of the drivers."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lidarslam.core.scan import Scan
from lidarslam.datasets.point_table import TIME_FIELDS, RawCloud, raw_cloud
from lidarslam.datasets.times.point_time import (
    UNITS_PER_SECOND,
    LearnedTime,
    PointTimeModel,
    infer_point_time,
    learn_point_time,
    value_spread,
)

STAMP = 1_700_000_000.25  # representable exactly
STAMP_NS = 1_700_000_000_250_000_000
SWEEP = np.linspace(0.0, 0.1, 1001)
SWEEP_NS = np.round(SWEEP * 1e9).astype(np.int64)


def inferred(*args, **kwargs):
    return infer_point_time(*args, **kwargs).model


@pytest.mark.parametrize(
    ("values", "unit", "reference", "offsets", "tolerance"),
    [
        pytest.param(SWEEP.astype("f4"), "s", "relative", SWEEP, 1e-7, id="velodyne"),
        pytest.param((SWEEP - 0.1).astype("f4"), "s", "relative", SWEEP - 0.1, 1e-7, id="velodyne-stamped-at-the-end"),
        pytest.param(SWEEP_NS.astype("u4"), "ns", "relative", SWEEP, 1e-9, id="ouster"),
        pytest.param((SWEEP_NS / 1e3).astype("f4"), "us", "relative", SWEEP, 1e-7, id="microseconds"),
        pytest.param((SWEEP_NS / 1e6).astype("f4"), "ms", "relative", SWEEP, 1e-7, id="milliseconds"),
        pytest.param(STAMP + SWEEP, "s", "absolute", SWEEP, 2e-7, id="hesai"),
        pytest.param((STAMP_NS + SWEEP_NS).astype("f8"), "ns", "absolute", SWEEP, 2e-7, id="livox-float64"),
        pytest.param((STAMP_NS + SWEEP_NS).astype("u8"), "ns", "absolute", SWEEP, 1e-9, id="nanoseconds-uint64"),
        pytest.param((STAMP_NS - SWEEP_NS).astype("i8"), "ns", "absolute", -SWEEP, 1e-9, id="nanoseconds-backwards"),
        pytest.param((STAMP_NS + SWEEP_NS) // 1000, "us", "absolute", SWEEP, 2e-6, id="epoch-microseconds"),
        pytest.param((STAMP_NS + SWEEP_NS) / 1e6, "ms", "absolute", SWEEP, 3e-7, id="epoch-milliseconds"),
        pytest.param(5_000_000_000_000 + SWEEP_NS, "ns", "absolute", SWEEP, 1e-9, id="clock-since-power-on"),
        pytest.param(STAMP - 3600.0 + SWEEP, "s", "absolute", SWEEP, 3e-7, id="clock-an-hour-late"),
    ],
)
def test_habits_of_drivers(values, unit, reference, offsets, tolerance):
    model = inferred("t", values, STAMP)
    assert model == PointTimeModel("t", unit, reference)
    np.testing.assert_allclose(model.offsets(values, STAMP), offsets, rtol=0.0, atol=tolerance)


@settings(max_examples=60, deadline=None)
@given(
    unit=st.sampled_from(sorted(UNITS_PER_SECOND)),
    reference=st.sampled_from(["relative", "absolute"]),
    sweep_s=st.floats(0.02, 0.3),
    where=st.floats(-1.0, 0.0),
    stamp_ns=st.integers(10 * 10**9, 2 * 10**18),
    know_period=st.booleans(),
)
def test_any_sweep_in_any_unit_is_recovered(unit, reference, sweep_s, where, stamp_ns, know_period):
    stamp = stamp_ns / 10**9
    offsets = (np.linspace(0.0, 1.0, 500) + where) * sweep_s
    readings = offsets + (stamp if reference == "absolute" else 0.0)
    values = readings * UNITS_PER_SECOND[unit]
    model = inferred("t", values, stamp, period_s=sweep_s if know_period else None)
    assert model == PointTimeModel("t", unit, reference)
    np.testing.assert_allclose(model.offsets(values, stamp), offsets, rtol=0.0, atol=1e-6)


@settings(max_examples=25, deadline=None)
@given(stamp_ns=st.integers(10**9, 4 * 10**18), dtype=st.sampled_from(["uint64", "float64"]))
def test_offsets_lose_nothing_of_a_clock_reading(stamp_ns, dtype):
    stamp = stamp_ns / 10**9  # rounded to float64, as Scan.stamp is
    values = (stamp_ns + SWEEP_NS[::100]).astype(dtype)
    offsets = PointTimeModel("t", "ns", "absolute").offsets(values, stamp)
    exact = [float(Fraction(value.item()) / 10**9 - Fraction(stamp)) for value in values]
    np.testing.assert_allclose(offsets, exact, rtol=0.0, atol=1e-15)


@pytest.mark.parametrize("values", [
    pytest.param(np.full(100, STAMP_NS, dtype="u8"), id="all-equal-integers"),
    pytest.param(np.array([0.05]), id="one-point"), pytest.param(np.empty(0, dtype="f4"), id="no-points"),
    pytest.param(np.r_[np.zeros(999), 0.1], id="all-equal-but-one"), pytest.param(SWEEP * 1e-7, id="span-of-no-sweep"),
])  # fmt: skip
def test_no_per_point_time(values):
    assert inferred("t", values, STAMP) is None


@pytest.mark.parametrize(
    ("values", "unit", "reference"),
    [
        pytest.param(SWEEP * 1e-3, "ks", "relative", id="a-thousandth"),
        pytest.param((SWEEP - 0.05) * 1e-6, "Ms", "relative", id="a-millionth"),
        pytest.param(SWEEP_NS * 1000, "ps", "relative", id="a-thousand-times-nanoseconds"),
        pytest.param(STAMP_NS + SWEEP_NS // 1000, "us", "absolute", id="microseconds-added-to-nanoseconds"),
    ],
)
def test_times_off_by_a_power_of_a_thousand_are_corrected(values, unit, reference):
    learned = infer_point_time("t", values, STAMP, period_s=0.1)
    assert learned.model == PointTimeModel("t", unit, reference)
    assert "reader.time_unit" in learned.warning
    offsets = learned.model.offsets(values, STAMP)
    np.testing.assert_allclose(offsets - offsets.min(), SWEEP, rtol=0.0, atol=2e-6)


def test_a_unit_by_definition_gives_way_to_what_the_values_span():
    """As in a Livox CustomMsg whose driver counts microseconds; a given unit does not."""
    found = infer_point_time("offset_time", SWEEP_NS // 1000, None, period_s=0.1, defined_unit="ns")
    assert found.model.unit == "us"
    assert "in units of us instead of ns" in found.warning
    asked = infer_point_time("offset_time", SWEEP_NS // 1000, None, "ns", period_s=0.1, defined_unit="ns")
    assert (asked.model.unit, asked.warning) == ("ns", None)


@pytest.mark.parametrize("part", [0.06, 0.3, 0.99, 1.4])
@pytest.mark.parametrize("scale", [1, 10**3, 10**6, 10**9])
def test_any_part_of_a_period_in_a_usual_unit_is_no_mistake(scale, part):
    learned = infer_point_time("t", part * scale * SWEEP, STAMP, period_s=0.1)
    assert (learned.warning, learned.model.units_per_second) == (None, scale)


@pytest.mark.parametrize("scale", [2e-3, 5e-4, 4e-5, 1.3e-3])
def test_a_scale_in_doubt_is_not_corrected(scale):
    learned = infer_point_time("t", scale * SWEEP, STAMP, period_s=0.1)
    assert learned.model is None
    assert "spans a sweep in no unit" in learned.warning


@pytest.mark.parametrize(("values", "said"), [
    (np.zeros(100), "one value alone (0)"), (np.full(100, STAMP), "one value alone (1.7e+09)"),
    (np.full(100, np.nan), "no number"), ((STAMP + SWEEP * 2000).astype("f4"), "too coarse"),
    (np.linspace(0.0, 1.009, 200), "fractions of a sweep, from 0 to 1; --set reader.time_unit=s"),
])  # fmt: skip
def test_what_is_no_time_is_said(values, said):
    cloud = RawCloud(np.ones((len(values), 3)), "stamps", values)
    model, warning = learn_point_time([(cloud, STAMP + 0.1 * number) for number in range(5)])
    assert model is None
    assert warning.startswith("The time field 'stamps'")
    assert said in warning


def test_a_first_cloud_without_times_is_no_fault_of_the_recording():
    clouds = [(RawCloud(np.ones((1001, 3)), "t", values), STAMP) for values in (np.zeros(1001), SWEEP)]
    assert learn_point_time(clouds) == LearnedTime(PointTimeModel("t", "s", "relative"))


def test_missing_returns_of_a_clock_read_zero():
    values = np.r_[np.zeros(1500, dtype="i8"), STAMP_NS + SWEEP_NS]
    model = inferred("timestamp", values, STAMP)
    assert model == PointTimeModel("timestamp", "ns", "absolute")
    offsets = model.offsets(values, STAMP)
    assert np.isnan(offsets[:1500]).all()
    np.testing.assert_allclose(offsets[1500:], SWEEP, rtol=0.0, atol=1e-9)


def test_stray_times_do_not_disturb():
    # As on destaggered clouds, where some columns hold leftovers.
    values = SWEEP_NS.astype("u4")
    values[[3, 700]] = 4_000_000_000
    model = inferred("t", values, STAMP)
    assert model == PointTimeModel("t", "ns", "relative")
    scan = Scan.from_raw(np.ones((len(values), 3)), STAMP, model.offsets(values, STAMP))
    assert (scan.dropped, scan.untimed) == (0, 2)
    assert scan.time_offsets.max() == pytest.approx(0.1)


def test_unit_follows_the_period_where_the_sweep_is_unusual():
    packet = np.linspace(0.0, 1.3, 200)  # a cloud a packet: 1.3 ms, written in ms
    assert inferred("t", packet, STAMP) is None
    assert inferred("t", packet, STAMP, period_s=0.00133).unit == "ms"


def test_given_unit_and_reference_are_obeyed():
    assert inferred("t", SWEEP, STAMP, unit="ms") == PointTimeModel("t", "ms", "relative")
    assert inferred("t", SWEEP_NS, STAMP, unit="us") == PointTimeModel("t", "us", "absolute")
    assert inferred("t", SWEEP + 0.5, 0.6, reference="absolute") == PointTimeModel("t", "s", "absolute")
    assert inferred("t", STAMP + SWEEP, STAMP, reference="relative") == PointTimeModel("t", "s", "relative")


def test_another_clock_is_a_warning_of_the_recording():
    model, warning = infer_point_time("timestamp", STAMP + 37.0 + SWEEP, STAMP)  # TAI against UTC
    assert "another clock" in warning
    assert not model.shares_clock(STAMP + 37.0 + SWEEP, STAMP)
    assert model.shares_clock(STAMP + SWEEP, STAMP)


@pytest.mark.parametrize(
    "names", [*([name] for name in TIME_FIELDS), ["T"], ["t", "timestamp"], ["t", "range"], ["scalar_Time"]]
)
def test_time_fields_are_found(names):
    table = np.zeros(3, [(name, "f4") for name in ("x", "y", "z", *reversed(names))])
    assert raw_cloud(table).time_field == names[0]
    assert raw_cloud(table, "z").time_field == "z"


@pytest.mark.parametrize("name", ["ring", "channel", "line", "laser_id", "range", "scalar_ring"])
def test_ring_fields_are_found_and_coordinates_in_upper_case(name):
    cloud = raw_cloud(np.ones(3, [(name, "f4") for name in ("X", "Y", "Z", name)]))
    assert (cloud.rings is None) == (name == "range")
    assert cloud.time_field is None
    assert cloud.points.tolist() == [[1.0, 1.0, 1.0]] * 3


@pytest.mark.parametrize("reference", ["auto", "none"])
def test_a_field_of_an_unknown_name_that_may_be_the_time_is_said(reference):
    cloud = raw_cloud(np.zeros(3, [(name, "f4") for name in ("x", "y", "z", "ring", "relative_time")]))
    model, warning = learn_point_time([(cloud, STAMP)], reference=reference)
    assert model is None
    assert (warning is None) == (reference == "none")
    assert warning is None or "reader.time_field=relative_time" in warning


@pytest.mark.filterwarnings("error")
def test_nan_of_any_kind_and_values_that_no_clock_reads_are_left_out() -> None:
    """A signalling NaN, as changed bytes may be, does not signal."""
    values = np.arange(8, dtype=np.float32)
    values[5] = np.nan
    values.view(np.uint32)[3] = 0x7FA00000
    spread = value_spread(values)
    assert spread is not None
    assert spread.middle == pytest.approx(3.0, abs=0.6)
    assert spread.span == pytest.approx(7.0, abs=0.1)
    assert value_spread(np.concatenate([SWEEP, [1.7e308, -1.7e308]])) == value_spread(SWEEP)
