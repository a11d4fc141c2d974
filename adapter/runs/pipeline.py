"""Front end and learner in one thread: what the live process does, without its clock."""

from __future__ import annotations

from adapter.effects.active import lasting_effects, with_bodies
from adapter.learning.learner import OnlineLearner
from adapter.learning.theta import Filtered, KnownArm
from adapter.model.self_model import SelfModel
from adapter.physics.rigid_arm import RigidArm
from adapter.runs.config import PipelineSettings
from adapter.signals.front_end import FrontEnd
from drivers.interface import JointSample


class Pipeline:
    """The two pure steps, composed.

    Args:
        documented: the arm as documented; the learner gets its topology, gravity, tool and
            effects only.
        settings: of the parts.

    Attributes:
        front_end, learner: the parts; estimates are read from the learner.
    """

    def __init__(self, documented: SelfModel, settings: PipelineSettings | None = None) -> None:
        self.settings = settings or PipelineSettings()
        self.front_end = make_front_end(documented, self.settings)
        self.learner = make_learner(documented, self.settings)

    def step(self, sample: JointSample) -> bool:
        """Take one sample; whether it was learned from."""
        states = self.front_end.step(sample)
        for state in states:
            self.learner.step(state)
        return len(states) > 0


def make_front_end(documented: SelfModel, settings: PipelineSettings) -> FrontEnd:
    """The front end of a pipeline with these settings."""
    imus = bool(settings.learner.schema.imus)
    return FrontEnd(documented, settings.filter, settings.front_end, imus)


def make_learner(documented: SelfModel, settings: PipelineSettings) -> OnlineLearner:
    """The learner of a pipeline with these settings; it takes over the effects of the model."""
    front_end = make_front_end(documented, settings)
    own = front_end.filter.settings
    whole = with_bodies(documented)
    known = lasting_effects(whole.effects, whole.tree.n)
    tool = documented.tool
    return OnlineLearner(
        documented.tree,
        documented.gravity,
        settings.learner,
        Filtered(
            front_end.filter.noise_gain, front_end.delay_s, own.step_s * own.samples_per_state
        ),
        KnownArm(
            tool_theta=None if tool is None else tool.theta(),
            effects=known,
            arm=None if whole is documented and not known else RigidArm.of(whole),
            lam=documented.lam,
            theta=whole.theta[-documented.tree.n :],
        ),
    )
