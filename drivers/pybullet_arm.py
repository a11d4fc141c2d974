"""The simulated arm behind the same interface as a real one."""

from __future__ import annotations

from typing import Protocol

from drivers.interface import Array, DriverError, Intake, JointSample


class Plant(Protocol):
    """What a simulated arm has to offer; whoever builds the driver hands one over."""

    joint_names: tuple[str, ...]
    link_names: tuple[str, ...]
    period_ns: int
    compute_ns: int

    def read(self) -> JointSample:
        """Move on by one period and give the sample there; the first call gives t = 0."""

    def command(self, tau: Array) -> None:
        """Drive with (n,) N m. Raises DriverError if it cannot."""

    def stop(self) -> None:
        """Close the brakes."""

    def close(self) -> None:
        """Free the simulator."""


class PyBulletArm:
    """Driver of a simulated arm.

    It does not pace itself: each `read` moves the arm on by one period with the last command and
    returns at once. Stamps count from 0 at the arm's start.

    Attributes:
        plant_time_ns: how long physics and sensors of the last `read` took. A real arm does
            this part in hardware, so a timing of the driver leaves it out.
    """

    paced = False
    can_move = True
    adds_gravity = False
    arrived_ns = 0
    delay_ns = 1_000_000

    def __init__(self, plant: Plant) -> None:
        self.joint_names = plant.joint_names
        self.link_names = plant.link_names
        self.period_ns = plant.period_ns
        self.plant_time_ns = 0
        self.intake = Intake()
        self._plant = plant
        self._open = False
        self._closed = False

    def connect(self) -> None:
        """Make the arm ready. Raises DriverError when it was closed before."""
        if self._closed:
            raise DriverError("the simulated arm was closed; build a new one")
        self._open = True

    def read(self) -> JointSample:
        """The next sample, one period after the last. Raises DriverError when not connected."""
        self._need_open()
        sample = self._plant.read()
        self.plant_time_ns = self._plant.compute_ns
        self.intake.received += 1
        self.intake.used += 1
        return sample

    def command(self, tau: Array) -> None:
        """Ask for (n,) N m, gravity included; reached one period after the last sample.

        Raises DriverError for anything but n finite numbers, when the arm has braked by itself
        because of a joint's range or speed, or when not connected.
        """
        self._need_open()
        self._plant.command(tau)

    def stop(self) -> None:
        """Close the arm's brakes; the next command opens them."""
        if self._open:
            self._plant.stop()

    def close(self) -> None:
        """Free the simulator; may be called more than once."""
        if not self._closed:
            self._plant.close()
        self._open, self._closed = False, True

    def _need_open(self) -> None:
        if not self._open:
            state = "closed; build a new one" if self._closed else "not connected; call connect()"
            raise DriverError(f"the simulated arm is {state}")
