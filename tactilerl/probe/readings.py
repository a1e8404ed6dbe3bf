"""From recorded grasps to what a classifier is given, and what it is asked."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ..envs.hands import SLIDES, Hand
from ..envs.layouts import Taxels
from ..envs.observations import SensorConfig, TaxelFaults, taxel_stages
from ..envs.state import KINDS, Array, Shape, State
from ..envs.touch import SkinTouch
from .grasps import Measured, links_of

BATCH = 200  # grasps read at once: what is in between takes memory


@dataclass(frozen=True)
class Grasps:
    """Recorded grasps of one hand, those that broke left out."""

    hand: Hand
    records: Measured

    @classmethod
    def whole(cls, hand: Hand, records: Measured) -> Grasps:
        """All but those that broke."""
        is_whole = ~records["broken"].astype(bool)
        return cls(hand, {name: values[is_whole] for name, values in records.items()})

    def __len__(self) -> int:
        return len(self.records["held"])

    @property
    def held(self) -> Array:
        """bool (n,)"""
        return self.records["held"].astype(bool)

    @property
    def angles(self) -> Array:
        """Positions of the hand's joints (n, joints) without its slides, rad."""
        own = [i for i, name in enumerate(self.hand.joints) if name not in SLIDES]
        return self.records["joint_positions"][:, own]

    def objects(self) -> tuple[list[str], Array]:
        """Kind and measures in mm of each object that there is; int (n,): which of them."""
        kind, sizes = self.records["object_kind"], self.records["object_half_size"]
        table = np.column_stack([kind, sizes.round(6)])
        rows, index = np.unique(table, axis=0, return_inverse=True)
        names = [
            f"{KINDS[int(kind)]} {' x '.join(f'{2e3 * s:g}' for s in sizes)} mm"
            for kind, *sizes in rows.tolist()
        ]
        return names, index.reshape(-1)

    def object_in_hand(self) -> tuple[Array, Array]:
        """The object's centre (n, 3) from the palm point and its orientation (n, 3, 3) in axes of
        the palm: along towards the fingertips, across, and out of the palm; m."""
        palm = links_of(self.hand).index(self.hand.palm)
        rotation = self.records["link_rotations"][:, palm]
        point = self.records["link_positions"][:, palm] + rotation @ np.array(
            self.hand.palm_point
        )
        along, palmar = np.array(self.hand.fingers), np.array(self.hand.palmar)
        axes = rotation @ np.column_stack([along, np.cross(palmar, along), palmar])
        away = self.records["object_position"] - point
        position = np.einsum("nij,ni->nj", axes, away)
        return position, axes.swapaxes(1, 2) @ _rotations(
            self.records["object_orientation"]
        )

    def turn(self) -> tuple[Array, int]:
        """Yaw (n,) of the object in the palm's plane, rad, and after how many equal parts of a turn
        it looks the same; 0 where it has no yaw."""
        is_box = (self.records["object_kind"] == KINDS.index("box")).all()
        half = self.records["object_half_size"]
        parts = 4 if np.allclose(half[:, 0], half[:, 1]) else 2
        _, rotation = self.object_in_hand()
        return np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0]), parts if is_box else 0

    def sight(self) -> Array:
        """The object's pose in the hand (n, 7): position, quaternion wxyz with w from 0 up."""
        position, rotation = self.object_in_hand()
        quaternion = Rotation.from_matrix(rotation).as_quat(
            canonical=True, scalar_first=True
        )
        return np.column_stack([position, quaternion])

    def feel(self, taxels: Taxels) -> Array:
        """Readings bool (n, taxels) by the rule "skin"."""
        touch = SkinTouch(taxels, self.hand)
        readings = np.zeros((len(self), len(taxels)), bool)
        names, which = self.objects()
        for index in range(len(names)):
            chosen = np.flatnonzero(which == index)
            for some in np.split(chosen, range(BATCH, len(chosen), BATCH)):
                readings[some] = touch.read(self._state(some))
        return readings

    def _state(self, some: Array) -> State:
        """Of grasps of one object."""
        of = {name: values[some] for name, values in self.records.items()}
        return State(
            shape=Shape(
                KINDS[int(of["object_kind"][0])],
                tuple(of["object_half_size"][0].tolist()),
            ),
            object_position=of["object_position"],
            object_rotation=_rotations(of["object_orientation"]),
            links=links_of(self.hand),
            link_positions=of["link_positions"],
            link_rotations=of["link_rotations"],
        )


def _rotations(quaternions: Array) -> Array:
    return Rotation.from_quat(quaternions, scalar_first=True).as_matrix()


def with_faults(
    readings: Array, faults: TaxelFaults, rng: np.random.Generator
) -> Array:
    """What the environment does to readings on their way, done to bool (n, taxels): the same taxels are
    broken in all."""
    sensors = SensorConfig(**asdict(faults), hand_seed=int(rng.integers(2**32)))
    for stage in taxel_stages(sensors, readings.shape[1]):
        stage.begin(rng)
        readings = stage(readings)
    return readings.astype(bool)
