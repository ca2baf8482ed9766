"""Where time goes: operations count without those that they call."""

import collections

from benchmarks.common.scopes import _add_own_times


def test_own_times_leave_out_what_is_called_and_count_for_the_nearest_scope():
    scopes = {"loop": "to_grid", "read": "law", "add": None, "after": None}
    events = [(0, -10, "loop"), (1, -3, "read"), (2, -1, "add"), (5, -2, "add"), (20, -4, "after")]
    total = collections.Counter()
    _add_own_times(events, scopes.get, total)
    # loop: 10 without 3 and 2, and the 2 of its own nameless call; read: 3 without 1, and that 1; after: on its own
    assert dict(total) == {"to_grid": 7, "law": 3, "rest": 4}
