"""The bare chain's swing in MuJoCo, where it is installed beside the program; it is not a dependency.

The same point masses on massless links with ball joints without friction, held at one end, let go from the horizontal.
Each link is a body whose mass sits in a small sphere at its far end, so that the model differs from the reference by
the sphere's own inertia, (r / d)², only.
"""

from __future__ import annotations

from time import perf_counter_ns
from typing import Any

import numpy as np

from trainer.bench import thread
from trainer.bench.rows import Row
from trainer.geometry import Array

MUJOCO_STEPS_S = (5e-3, 2e-3, 1e-3, 5e-4)
MISSING = "not measured: mujoco is not installed"


def _chain(mujoco: Any, links: int, step_s: float) -> tuple[Any, Any]:
    """MuJoCo's model and data of ``thread.bare(links)``, in m, kg and s."""
    model = thread.bare(links)
    link, mass = model.link * 1e-3, model.mass * model.link
    bodies = ""
    for i in range(links):
        m = mass * (0.5 if i == links - 1 else 1.0)
        place = 0.0 if i == 0 else link
        bodies += (
            f'<body pos="{place} 0 0"><joint type="ball" armature="0" damping="0"/>'
            f'<inertial pos="{link} 0 0" mass="{m}" diaginertia="{m * 1e-8} {m * 1e-8} {m * 1e-8}"/>'
        )
    text = (
        f'<mujoco><option timestep="{step_s}" gravity="0 0 -9.81" integrator="RK4"/>'
        f'<compiler boundmass="0" boundinertia="0"/><worldbody>{bodies}{"</body>" * links}</worldbody></mujoco>'
    )
    built = mujoco.MjModel.from_xml_string(text)
    return built, mujoco.MjData(built)


def _places(data: Any, links: int, link: float) -> Array:
    """Nodes (links + 1, 3) mm."""
    x = np.zeros((links + 1, 3))
    x[:-1] = np.asarray(data.xpos)[1:] * 1e3
    x[-1] = x[-2] + link * np.asarray(data.xmat)[-1].reshape(3, 3)[:, 0]
    return x


def measure(links: int = 50, steps_s: tuple[float, ...] = MUJOCO_STEPS_S) -> list[Row]:
    """A row for each step of MuJoCo's Runge-Kutta integrator; without MuJoCo one row that says so."""
    try:
        import mujoco  # type: ignore[import-not-found, unused-ignore]
    except ImportError:
        nan = float("nan")
        return [Row("swing, bare", links, "mujoco ball chain", "-", 0, nan, nan, nan, MISSING, nan, MISSING)]
    model = thread.bare(links)
    h = thread.reference_step(model, False)
    expected = thread.answers(model, thread.still, h)
    rows = []
    for step_s in steps_s:
        built, data = _chain(mujoco, links, step_s)
        mujoco.mj_forward(built, data)
        ms, error = [], 0.0
        for frame in range(1, len(expected)):
            begun = perf_counter_ns()
            for _ in range(round(thread.FRAME_S / step_s)):
                mujoco.mj_step(built, data)
            ms.append((perf_counter_ns() - begun) * 1e-6)
            mujoco.mj_kinematics(built, data)
            far = np.linalg.norm(_places(data, links, model.link) - expected[frame], axis=1)
            error = max(error, float(np.max(far)) / model.length)
        median, p90 = (float(v) for v in np.percentile(ms, (50, 90)))
        of = thread.ERROR_OF.format(thread.REFERENCE.format(links, h))
        ended = "converged" if error < 1.0 else "lost"
        rows.append(
            Row("swing, bare", links, "mujoco ball chain", f"RK4, {step_s * 1e3:g} ms", len(ms), median, p90, error, of,
                0.0, ended, thread.LENGTHS)
        )  # fmt: skip
    return rows
