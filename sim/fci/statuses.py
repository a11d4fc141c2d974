"""Status codes of the replies: the same answer has another number in each version."""

from __future__ import annotations

OK, NOT_POSSIBLE, INVALID = "ok", "not possible", "invalid argument"
STARTED, PREEMPTED = "motion started", "preempted"
REFLEX, EMERGENCY, INPUT_ERROR, ABORTED = "reflex", "emergency", "input error", "aborted"
MANUAL = "manual recovery required"
INCOMPATIBLE, ERROR = "incompatible", "error"

_MOVE = {
    5: {
        OK: 0, STARTED: 1, PREEMPTED: 2, NOT_POSSIBLE: 3, INVALID: 5, REFLEX: 6, EMERGENCY: 7,
        INPUT_ERROR: 8, ABORTED: 9,
    },
    10: {
        OK: 0, STARTED: 1, PREEMPTED: 2, NOT_POSSIBLE: 5, INVALID: 7, REFLEX: 8, EMERGENCY: 9,
        INPUT_ERROR: 10, ABORTED: 11,
    },
}  # fmt: skip
_STOP = {
    5: {OK: 0, NOT_POSSIBLE: 1, EMERGENCY: 2, REFLEX: 3, ABORTED: 4},
    10: {OK: 0, NOT_POSSIBLE: 1, EMERGENCY: 3, REFLEX: 4, ABORTED: 5},
}
_RECOVERY = {
    5: {OK: 0, NOT_POSSIBLE: 1, MANUAL: 2, REFLEX: 3, EMERGENCY: 4, ABORTED: 5},
    10: {OK: 0, NOT_POSSIBLE: 1, MANUAL: 3, REFLEX: 4, EMERGENCY: 5, ABORTED: 6},
}
_SIMPLE = {OK: 0, NOT_POSSIBLE: 1, INVALID: 2}
_TWO = {OK: 0, INCOMPATIBLE: 1, ERROR: 1}


def code_of(request: str, status: str, version: int) -> int:
    """Number of a status in the reply to a request (a name of `requests.NAMES`)."""
    if request == "Move":
        return _MOVE[version][status]
    if request == "StopMove":
        return _STOP[version][status]
    if request == "AutomaticErrorRecovery":
        return _RECOVERY[version][status]
    if request in ("Connect", "LoadModelLibrary"):
        return _TWO[status]
    return _SIMPLE[status]
