"""MuJoCo's own viewer beside a running scene."""

from __future__ import annotations

import threading
import time
import warnings
from collections.abc import Callable, Iterable
from typing import Any

import mujoco
import numpy as np

from ..state import Array
from . import Camera, Sphere
from .mujoco import OBJECT, MujocoSimulator, add_spheres

FPS = 50  # pictures a second of the scene's time, about
SLOWEST = 1 / 64  # of real time
SPACE, MINUS, EQUAL = map(ord, " -=")  # codes of keys: the viewer's own keys for speed
STIFFNESS = 400.0  # of the mouse's pull, 1/s²: 25 mm carry an object; more is unstable at this FPS
LATE = 0.5  # s by which a slow machine may be behind before it is forgotten


class ClosedError(Exception):
    """The viewer's window has been closed."""


class Viewed:
    """A simulator whose steps are seen, in real time or slower, and disturbed by the mouse.

    The viewer shows a copy of the scene. What the mouse pulls there is added to the forces of the
    scene and replaces none: an object may be in somebody's hand meanwhile.
    """

    def __init__(
        self,
        simulator: MujocoSimulator,
        spheres: Callable[[], Iterable[Sphere]],
        speed: float = 1.0,
    ) -> None:
        """`spheres` are drawn besides, `speed` is that of the scene's time. OSError where no window can
        be opened."""
        self._inner, self._spheres, self._speed = simulator, spheres, speed
        self._is_paused, self._due = False, time.monotonic()
        self._shown = mujoco.MjData(simulator.model)
        simulator.model.vis.map.stiffness = STIFFNESS
        self._every = max(1, round(1 / FPS / simulator.scene.timestep))
        before = {*threading.enumerate()}
        self._viewer = _opened(simulator.model, self._shown, self._pressed)
        self._threads = {*threading.enumerate()} - before
        camera, usual = self._viewer.cam, Camera()
        camera.type = mujoco.mjtCamera.mjCAMERA_TRACKING
        camera.trackbodyid = simulator.model.body(simulator.scene.hand.palm).id
        camera.azimuth, camera.elevation = usual.azimuth, usual.elevation
        camera.distance = 1.5 * usual.distance
        self._viewer.perturb.select = simulator.model.body(OBJECT).id

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)

    def step(self, joint_targets: Array, n_substeps: int) -> None:
        """The same steps in portions, each shown when it is due. ClosedError when there is nobody to
        see it."""
        data = self._inner.data
        while n_substeps > 0:
            portion = min(n_substeps, self._every)
            pull = self._shown.xfrc_applied.copy()
            data.xfrc_applied += pull
            try:
                self._inner.step(joint_targets, portion)
            finally:
                data.xfrc_applied -= pull
            n_substeps -= portion
            self._show(portion * self._inner.scene.timestep)

    def _show(self, seconds: float) -> None:
        """What is true now, so many of the scene's seconds after it was shown last."""
        now = time.monotonic()
        self._due = max(self._due + seconds / self._speed, now - LATE)
        while True:
            self._sync()
            if not self._is_paused and (left := self._due - time.monotonic()) <= 0:
                break
            time.sleep(1 / FPS if self._is_paused else min(left, 1 / FPS))
            if self._is_paused:
                self._due = time.monotonic()

    def _sync(self) -> None:
        if not self._viewer.is_running():
            raise ClosedError("the window has been closed")
        with self._viewer.lock():
            mujoco.mj_copyData(self._shown, self._inner.model, self._inner.data)
            drawn = self._viewer.user_scn
            drawn.ngeom = 0
            add_spheres(drawn, [*self._spheres()])
            for number in range(drawn.ngeom):
                drawn.geoms[
                    number
                ].emission = 1.0  # they shine: the palm is in the shade
        self._viewer.sync()  # also writes the mouse's pull into the copy

    def _pressed(self, key: int) -> None:
        if key == SPACE:
            self._is_paused = not self._is_paused
        elif key in (MINUS, EQUAL):
            factor = 0.5 if key == MINUS else 2.0
            self._speed = float(np.clip(self._speed * factor, SLOWEST, 1.0))

    def close(self) -> None:
        self._viewer.close()
        for (
            thread
        ) in self._threads:  # it draws until its end, and must not outlive the scene
            thread.join()
        self._inner.close()


def _opened(
    model: mujoco.MjModel, data: mujoco.MjData, pressed: Callable[[int], None]
) -> Any:
    """The viewer's handle; OSError where there is no display, which the viewer would wait for."""
    try:
        with warnings.catch_warnings(
            action="ignore"
        ):  # GLFW's, before the error says it
            import glfw
            import mujoco.viewer as viewer

            if not glfw.init():
                raise OSError("no window can be opened here: found no display")
        return viewer.launch_passive(
            model, data, key_callback=pressed, show_left_ui=False, show_right_ui=False
        )
    except (ImportError, RuntimeError) as error:
        raise OSError(f"no window can be opened here: {error}") from error
