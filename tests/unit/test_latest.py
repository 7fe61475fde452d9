from threading import Event, Thread

from nlos_cam.view.viewer import Latest


def test_a_late_reader_gets_the_newest_value_only() -> None:
    slot = Latest[str]()
    for value in "abc":
        slot.put(value)
    newest = slot.after(0, 1.0)
    assert newest == (3, "c")
    assert slot.after(3, 0.0) is None


def test_a_waiting_reader_is_woken_by_a_value() -> None:
    slot = Latest[int]()
    found: list[tuple[int, int] | None] = []
    reader = Thread(target=lambda: found.append(slot.after(0, 10.0)))
    reader.start()
    slot.put(7)
    reader.join(10.0)
    assert found == [(1, 7)]


def test_closing_wakes_every_reader_with_nothing() -> None:
    slot = Latest[int]()
    found: list[tuple[int, int] | None] = []
    readers = [Thread(target=lambda: found.append(slot.after(0, 10.0))) for _ in range(3)]
    for reader in readers:
        reader.start()
    slot.close()
    for reader in readers:
        reader.join(10.0)
    assert found == [None] * 3
    slot.put(1)
    assert slot.after(0, 0.0) is None


def test_a_value_that_is_there_is_passed_over_for_one_that_comes_soon() -> None:
    slot, waits = Latest[str](), Event()
    slot.put("there")

    def put_more() -> None:
        for number in range(1000):  # until the reader is through, whenever it begins
            slot.put(f"fresh {number}")
            if waits.wait(0.005):
                return

    writer = Thread(target=put_more)
    writer.start()
    before = slot.after(0, 0.0)
    newest = slot.fresh(0, 10.0, 0.0)
    waits.set()
    writer.join(10.0)
    assert before is not None
    assert newest is not None
    assert newest[0] > before[0]


def test_a_value_that_is_there_is_taken_if_none_comes() -> None:
    slot = Latest[str]()
    slot.put("there")
    assert slot.fresh(0, 0.01, 0.0) == (1, "there")
    assert slot.fresh(1, 10.0, 0.01) is None
