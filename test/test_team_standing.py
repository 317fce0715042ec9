"""When a robot of a team stands."""

from hmt_slam_ros.team.standing import StandingTimer


def due_times(timer, times, *, is_searching):
    """The times at which the own status comes."""
    found = []
    for now in times:
        if timer.is_due(now, is_searching=is_searching):
            timer.note_status(now)
            found.append(now)
    return found


def test_the_own_status_comes_once_after_the_last_keyframe_event():
    timer = StandingTimer()
    assert due_times(timer, [1.0, 5.0], is_searching=False) == []
    timer.note_event(10.0)
    assert due_times(timer, [12.0, 13.0, 13.25, 20.0, 60.0], is_searching=False) == [13.25]
    timer.note_event(61.0)
    assert due_times(timer, [62.0, 65.0, 70.0], is_searching=False) == [65.0]


def test_the_own_status_comes_again_while_the_process_searches():
    timer = StandingTimer()
    timer.note_event(10.0)
    assert due_times(timer, [12.0, 13.25, 13.5, 14.0, 14.25, 15.0], is_searching=True) == [13.25, 14.0, 15.0]
