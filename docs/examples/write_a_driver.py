"""A driver is one class. This one only listens; drivers/README.md tells how to move an arm."""

import adapter
from drivers.interface import Driver, DriverError, EndOfStream, Intake, JointSample


class MyArm:  # the wire is a recording here, which sends its rows one by one
    link_names: tuple[str, ...] = ()  # no sensors on the links
    period_ns, delay_ns, arrived_ns = 1_000_000, 0, 0
    paced, can_move, adds_gravity = True, False, False  # the arm sets the rhythm; listen only

    def __init__(self) -> None:
        self._wire = adapter.read_log("recordings/panda_nominal_6s.mcap")
        self.joint_names, self.intake, self._next = self._wire.joint_names, Intake(), -1

    def connect(self) -> None:
        self._next = 0

    def read(self) -> JointSample:
        if self._next < 0:
            raise DriverError("not connected; call connect first")
        if self._next == len(self._wire):
            raise EndOfStream("the wire has said everything")
        k, w, self._next = self._next, self._wire, self._next + 1
        self.intake.received, self.intake.used = self.intake.received + 1, self.intake.used + 1
        return JointSample(int(w.stamp_ns[k]), w.q[k].copy(), w.dq[k].copy(), w.tau[k].copy())

    def command(self, tau: object) -> None:
        raise DriverError("this arm only listens")

    def stop(self) -> None: ...
    def close(self) -> None: ...


if __name__ == "__main__":  # else: adapter run --driver write_a_driver.py:MyArm --robot panda
    arm: Driver = MyArm()
    arm.connect()
    learner = adapter.Learner("panda")
    print([learner.step(1e-9 * s.stamp_ns, s.q, s.dq, s.tau) for s in (arm.read(), arm.read())])
