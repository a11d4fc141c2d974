"""From a discovered tree to λ, and to θ where torques were recorded.

Once N and A are known, body schema and dynamics are the paper's problems (eqs. 18, 19), solved by
`adapter.learning.batch` from the same filtered samples.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from adapter.discovery.bodies import NO_JOINT
from adapter.discovery.frames import in_joint_frame
from adapter.discovery.hypotheses import Option
from adapter.discovery.verdict import UNSEEN_BASE, Discovery
from adapter.errors import ModelError
from adapter.judgement.noise import LEAST_NM
from adapter.learning.batch.schema import SchemaResult, schema_from_moments
from adapter.learning.batch.theta_factors import row_factors, scales, system
from adapter.learning.batch.theta_filling import filled_words
from adapter.learning.batch.theta_solvers import consistent_theta, least_squares_theta
from adapter.learning.imu_fit import LEAST_STD
from adapter.learning.theta import PRIOR_STD, neutral_body
from adapter.learning.tree_data import BodyMotion, TreeData
from adapter.model.self_model import LAMBDA_MEASURED, SelfModel, gravity_down
from adapter.model.spatial import Array
from adapter.model.tree import BASE, Tree
from adapter.physics.identifiability import numerical_rank

ROUNDS = 3  # of weighting


@dataclass(frozen=True)
class LearnedTree:
    """λ of a discovered tree.

    Attributes:
        data: the samples, joints and links in the tree's order.
        schema: λ, its spread, what of it the data show.
    """

    data: TreeData
    schema: SchemaResult


def learn(discovery: Discovery) -> LearnedTree:
    """λ of the most likely tree.

    Raises:
        ModelError: the tree has more than one root, or joints that move no link of it.
    """
    data = tree_data(discovery)
    log = discovery.log
    excess = discovery.hypotheses.excess
    noise = dict.fromkeys(("w", "v", "a", "dw"), 0.0)
    for k, variance in discovery.bodies.noise.items():
        moving = variance[variance > 0.0]
        size = np.median(moving) if len(moving) else 0.0
        # more than none at all: a link at rest must not get an infinite weight
        noise[k] = float(np.sqrt(size * excess.get(k, 1.0))) + LEAST_STD
    schema = schema_from_moments(data, np.array(list(noise.values())))
    # neighbouring samples share their noise: the filter leaves fewer independent ones
    gain = np.sqrt(max(1.0, log.samples / log.noise_samples))
    return LearnedTree(data, replace(schema, std=schema.std * gain))


def tree_data(discovery: Discovery) -> TreeData:
    """The recording's filtered samples, in the order of the discovered tree and its joint frames.

    Raises:
        ModelError: the tree has more than one root, or joints that move no link of it.
    """
    order, root = _order(discovery)
    log = discovery.log
    motion = {k: x.copy() for k, x in discovery.bodies.motion.items()}
    for option in discovery.structure.chosen:
        if option.mounting is not None:  # its axis was found
            own = in_joint_frame(discovery.bodies.motion, option.link, option.mounting)
            for k, x in own.items():
                motion[k][:, option.link] = x
    number = {option.link: k for k, option in enumerate(order)}
    parent = tuple(number.get(option.parent, BASE) for option in order)
    links = [option.link for option in order]
    joints = [option.joint for option in order]
    names = log.link_names
    unseen = root == discovery.bodies.unseen_base
    floating = not unseen and not bool(discovery.bodies.at_rest[root])
    tree = Tree(
        parent,
        floating,
        tuple(log.joint_names[s] for s in joints),
        tuple(names[k] for k in links),
        UNSEEN_BASE if unseen else names[root],
    )
    m = len(log.q)
    tau: Array = np.zeros((m, tree.rows))
    if log.tau is not None:
        tau[:, tree.rows - tree.n :] = log.tau[:, joints]

    def part(bodies: list[int] | int) -> BodyMotion:
        nothing = np.zeros_like(motion["w"][:, bodies])
        return BodyMotion(
            motion["w"][:, bodies],
            motion["a"][:, bodies] if "a" in motion else nothing,
            motion["dw"][:, bodies],
            motion["v"][:, bodies] if "v" in motion else None,
        )

    signals = (log.q[:, joints], log.dq[:, joints], log.ddq[:, joints])
    return TreeData(tree, *signals, tau, part(root), part(links))


def _order(discovery: Discovery) -> tuple[list[Option], int]:
    """Options with a joint, parents first, and the body that is the root."""
    bodies, chosen = discovery.bodies, discovery.structure.chosen
    if discovery.root is None:
        raise ModelError("more than one link is carried by nothing: no tree to learn λ of")
    rigid = [bodies.log.link_names[o.link] for o in chosen if o.joint == NO_JOINT]
    jointed = [o for o in chosen if o.joint != NO_JOINT]
    names = bodies.log.link_names
    root = names.index(discovery.root) if discovery.root in names else bodies.unseen_base
    assert root is not None
    if len(jointed) < len(bodies.log.joint_names) or len(chosen) - len(jointed) > (
        root != bodies.unseen_base
    ):
        raise ModelError(
            f"{len(jointed)} of {len(bodies.log.joint_names)} joints move a link of the tree "
            f"and links without a joint are {', '.join(rigid) or 'none'}: no tree to learn λ of"
        )
    placed = {root}
    order: list[Option] = []
    while len(order) < len(jointed):
        ready = [o for o in jointed if o.parent in placed and o.link not in placed]
        order += ready
        placed |= {o.link for o in ready}
    return order, root


def self_model(
    discovery: Discovery, learned: LearnedTree, name: str
) -> tuple[SelfModel, Array | None]:
    """The self model of a discovered tree, and the torque (n,), N m rms, left unexplained.

    θ is learned where torques and accelerations with gravity were recorded; else it is that of
    neutral bodies, the second result is None and the provenance says so.

    Args:
        name: of the robot.
    """
    data, schema = learned.data, learned.schema
    tree = data.tree
    with_torque = discovery.log.tau is not None and "a" in discovery.bodies.motion
    left = None
    theta, arbitrary = np.tile(neutral_body(), (tree.bodies, 1)), ["all"]
    if with_torque and np.abs(data.tau).max() > 0.0:
        theta, left, arbitrary = theta_of(data, schema.lam)
    gravity = gravity_down()
    if not tree.floating and "a" in discovery.bodies.motion:
        gravity = -data.base.a.mean(axis=0)
    return SelfModel(
        name=name,
        tree=tree,
        lam=schema.lam,
        theta=theta,
        gravity=gravity,
        lam_std=np.where(schema.observable, schema.std, np.nan),
        lam_identifiable=schema.observable,
        lambda_source=LAMBDA_MEASURED,
        provenance={
            "discovered": {
                "confidence": {e.link: e.confidence for e in discovery.edges},
                "undecided": list(discovery.undecided),
                "mounting": {k: m.as_dict() for k, m in discovery.mountings.items()},
                "lambda_arbitrary": schema.freedom.words(tree),
                "theta": "learned from joint torques" if left is not None else "not learned",
                "theta_arbitrary": arbitrary,
            }
        },
    ), left


def theta_of(data: TreeData, lam: Array) -> tuple[Array, Array, list[str]]:
    """θ (bodies, 10), the torque (n,), N m rms, that it leaves unexplained, and what is arbitrary.

    The wrench on a floating base is not used: nothing in a recording measures it. What torques
    don't show stays near a neutral body, which is said by link. Friction is not modelled.

    Args:
        data: samples with joint torques; the base's motion with gravity.
        lam: (n, 6) λ.
    """
    rows = [row for row in row_factors(data, lam) if row.kind == "torque"]
    first = data.tree.bodies - data.tree.n
    bodies = tuple(range(first, data.tree.bodies))
    theta = np.tile(neutral_body(), (data.tree.bodies, 1))
    std = scales(rows)
    for _ in range(ROUNDS):  # weighted by what the round before left
        r, b = system(rows, std, bodies)
        theta[first:] = least_squares_theta(r, b, theta[first:]).theta
        std = np.array([max(row.residual(theta), LEAST_NM) for row in rows])
    shown = numerical_rank(system(rows, std, bodies)[0])[1]
    arbitrary = filled_words(shown, data.tree.body_names[first:])
    # below, rows that hold θ to a neutral body, by how far links differ from one another
    r, b = system(rows, std, bodies)
    weight = np.diag(np.tile(1.0 / PRIOR_STD, len(bodies)))
    centre = weight @ np.tile(neutral_body(), len(bodies))
    theta[first:] = consistent_theta(np.vstack([r, weight]), np.r_[b, centre]).theta
    return theta, np.array([row.residual(theta) for row in rows]), arbitrary
