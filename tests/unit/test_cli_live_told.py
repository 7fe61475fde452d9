from nlos_cam.cli.live import told
from nlos_cam.live.statistics import RunReport

TIMES = {"p50": 1.04, "p95": 2.0, "p99": 3.06}


def report(**others: object) -> RunReport:
    stages = {"wait": TIMES, "delivery": TIMES, "network": TIMES}
    given = {"stages_percentiles_ms": stages, **others}
    return RunReport(10, 29.97, 2, {"p50": 9.0, "p95": 14.0, "p99": 21.0}, {}, {}, {}, **given)  # type: ignore[arg-type]


def test_what_makes_up_the_latency_is_told_first() -> None:
    [line] = [line for line in told(report()).splitlines() if line.startswith("stages")]
    assert line.startswith("stages   delivery 1.0 3.1, network 1.0 3.1, wait 1.0 3.1")


def test_nothing_is_told_of_what_did_not_happen() -> None:
    assert [line.split()[0] for line in told(report()).splitlines()] == ["10", "latency", "stages"]


def test_verdicts_and_stalls_are_told_where_there_were_some() -> None:
    lines = told(report(verdicts={"object seen": 7, "nothing there": 3}, stalled_s=1.25)).splitlines()
    assert "verdicts 7 object seen, 3 nothing there" in lines
    assert "stalled  1.2 s without a frame" in lines
