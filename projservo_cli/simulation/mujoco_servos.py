"""The joints of an arm in MuJoCo: servos under gravity, from its file or defaults."""

import copy
import math
from typing import Any, NamedTuple

import numpy as np

from projservo_cli.findings import LIMITS, Finding, Subject
from projservo_cli.records import FloatArray, InputError, WorkFailed
from projservo_cli.simulation.mjcf import mujoco
from projservo_cli.simulation.rendering import RenderedModel

_STEP_S = 0.002  # longest step of the integration
_RATE = 100.0  # 1/s, at which a servo that need not sag takes back an error
_LOOP_S = 0.1  # time in which a speed controller corrects an error
_POSTURES = 200  # random postures to find the loads of servos


class _Actuator(NamedTuple):
    """An actuator of a file that drives a joint: force = gain · input + bias · (1, length, its speed).

    It follows lengths if the length has a part in it, otherwise speeds if they have, otherwise it is a motor.
    """

    number: int
    state: int  # place of its activation, −1 for none
    integrates: bool  # whether its control is the speed of its input
    gear: float
    gain: float
    bias: tuple[float, float, float]

    @property
    def stiffness(self) -> float:
        """Return the torque per radian of position error of an added servo; 0 for a motor."""
        _, by_length, by_speed = self.bias
        return -(self.gear**2) * (by_length or by_speed / _LOOP_S)

    def input_for(self, q: float, x: float, speed: float) -> float:
        """Input with which a joint at q goes to x, rad or m, that moves at a speed, per s."""
        constant, by_length, by_speed = self.bias
        if by_length:
            return -(constant + by_length * self.gear * x) / self.gain
        return -(constant + by_speed * self.gear * (speed + (x - q) / _LOOP_S)) / self.gain


class Physics:
    """Servos of the joints of an arm, at first at rest at joints q (n,), rad or m.

    lag_s : lag of the set-points. sag : steady-state error of the added servo with the maximum load,
        rad; if it is zero, and in prismatic joints, they compensate gravity.
    ``setpoint``: (n,) where joints are sent, rad or m. ``force``: the greatest force on the arm by contacts
    not part of it, N, in the steps of the last ``follow``.
    Raises InputError if an actuator of the file cannot be driven, or cannot have this sag.
    """

    def __init__(self, rendered: RenderedModel, q: FloatArray, lag_s: float, sag: float) -> None:
        arm, servo = rendered.scene.arm, rendered.scene.options.servo
        self._model, self._places, self._rates = (
            copy.copy(rendered.model),
            rendered.positions,
            rendered.rates,
        )
        self._joints = rendered.joints
        self._data = rendered.begin(self._model, q)
        first = int(self._model.jnt_bodyid[rendered.joints[0]])
        # (g,) whether the first joint of the arm moves a shape.
        self._carried = np.array([self._carries(first, int(one)) for one in self._model.geom_bodyid], bool)
        self._step_s, self._lag_s = min(_STEP_S, float(self._model.opt.timestep)), lag_s
        self._own = {
            i: actuator
            for i, joint in enumerate(rendered.joints)
            if (actuator := _take(self._model, int(joint), keep=servo == "own")) is not None
        }
        if sag > 0.0 and self._own:
            raise InputError(
                "disturbance.gravity_sag_deg: servos of robot.mjcf sag by their own gains: remove it, or set "
                "plant.options.servo: position"
            )
        turning = ~arm.prismatic
        self._compensated = ~turning if sag > 0.0 else np.ones(len(q), dtype=np.bool_)
        inertia, load = self._heaviest(rendered)
        stiff = inertia * (_RATE / _LOOP_S if servo == "velocity" else _RATE**2)
        self._stiffness = np.where(self._compensated, stiff, load / sag if sag > 0.0 else 0.0)
        critical = 2.0 * np.sqrt(self._stiffness * inertia)
        self._damping = _LOOP_S * self._stiffness if servo == "velocity" else critical
        self._ours = np.array([i for i in range(len(q)) if i not in self._own], dtype=np.int64)
        self._model.dof_damping[self._rates[self._ours]] += self._damping[self._ours]
        self._motors = np.array([i for i, own in self._own.items() if not own.stiffness], dtype=np.int64)
        self.force = 0.0
        self._begin(q)

    def _begin(self, q: FloatArray) -> None:
        """Send each joint to where its servo holds it at rest at joints (n,)."""
        load, stiffness = self._gravity(), np.where(self._compensated, math.inf, self._stiffness)
        for i, actuator in self._own.items():
            stiffness[i] = actuator.stiffness or math.inf
        self.setpoint = self._sent = q + load / stiffness
        for i, actuator in self._own.items():
            if actuator.state >= 0:
                self._data.act[actuator.state] = actuator.input_for(q[i], self._sent[i], 0.0)

    @property
    def motor(self) -> FloatArray:
        """Return the joints (n,), rad or m."""
        return np.array(self._data.qpos[self._places])

    @property
    def obstruction(self) -> tuple[Finding, ...]:
        """Return what obstructs the arm: contacts, saturated servos."""
        touching, weak = self._touching(), tuple(i + 1 for i in self._own if self._at_end(i))
        found = [Finding("arm_touches", LIMITS, Subject(name=touching))] if touching else []
        return *found, *([Finding("servos_at_end", LIMITS, Subject(joints=weak))] if weak else ())

    def _at_end(self, joint: int) -> bool:
        """Whether the actuator of a joint can do no more than it does."""
        model, data, k = self._model, self._data, self._own[joint].number
        limits = (
            (model.actuator_ctrllimited[k], data.ctrl[k], model.actuator_ctrlrange[k]),
            (model.actuator_forcelimited[k], data.actuator_force[k], model.actuator_forcerange[k]),
            (
                model.jnt_actfrclimited[self._joints[joint]],
                data.qfrc_actuator[self._rates[joint]],
                model.jnt_actfrcrange[self._joints[joint]],
            ),
        )
        return any(limited and not low < value < high for limited, value, (low, high) in limits)

    def _touching(self) -> str:
        """Return the contacts of the arm, by names of bodies; empty if there are none."""
        model, pairs = self._model, dict[str, None]()
        for contact in self._data.contact:
            bodies = [int(model.geom_bodyid[geom]) for geom in contact.geom]
            if contact.dist < 0.0 and self._carried[contact.geom].any():
                pairs[" and ".join(model.body(body).name or f"body {body}" for body in bodies)] = None
        return ", ".join(pairs)

    def _pressed(self) -> float:
        """Return the size of the sum of all forces on the arm by bodies that it does not move, N."""
        total, wrench, contact = np.zeros(3), np.zeros(6), self._data.contact
        first, second = self._carried[contact.geom].T
        for i in np.flatnonzero(first != second).tolist():
            mujoco().mj_contactForce(self._model, self._data, i, wrench)
            total += (1.0 if second[i] else -1.0) * wrench[:3] @ contact.frame[i].reshape(3, 3)
        return float(np.linalg.norm(total))

    def _carries(self, carrier: int, body: int) -> bool:
        """Whether a body is another, or fixed or jointed to it from there on."""
        while body > carrier:  # bodies come after their carriers
            body = int(self._model.body_parentid[body])
        return body == carrier

    def strike(self, by: FloatArray) -> None:
        """Move joints, and where they are sent, by (n,), rad or m, at once."""
        self._data.qpos[self._places] += by
        self.setpoint, self._sent = self.setpoint + by, self._sent + by

    def follow(self, setpoint: FloatArray, seconds: float) -> None:
        """Let ``seconds`` pass while the set-point goes evenly to joints (n,), rad or m.

        Raises WorkFailed if the integration comes to nothing.
        """
        if not seconds > 0.0:
            self.setpoint = setpoint
            return
        steps = math.ceil(seconds / self._step_s - 1e-9)
        h, begun, mj, self.force = seconds / steps, self.setpoint, mujoco(), 0.0
        self._model.opt.timestep = h
        for k in range(1, 1 + steps):
            self.setpoint = begun + (setpoint - begun) * (k / steps)
            share = -math.expm1(-h / self._lag_s) if self._lag_s > 0.0 else 1.0
            before, self._sent = self._sent, self._sent + share * (self.setpoint - self._sent)
            self._drive((self._sent - before) / h, h)
            mj.mj_step(self._model, self._data)
            self.force = max(self.force, self._pressed())
        self.setpoint = setpoint
        if self._data.warning[mj.mjtWarning.mjWARN_BADQACC].number or not np.isfinite(self.motor).all():
            raise WorkFailed(
                "plant mujoco: the physics of the arm do not settle: look at masses, armature and servos of "
                "robot.mjcf, or lower its timestep"
            )

    def _drive(self, speed: FloatArray, h: float) -> None:
        """Actuate servos for the next step of h, s, with set-points moving at a speed (n,), per s."""
        q, data = self.motor, self._data
        gravity, torque = self._gravity(), self._stiffness * (self._sent - q) + self._damping * speed
        torque += np.where(self._compensated, gravity, 0.0)
        data.qfrc_applied[self._rates[self._ours]] = torque[self._ours]
        # Each motor gives the load of its joint in this posture, where the other joints are free.
        inertia = self._free_inertia() if self._motors.size else np.zeros(0)
        off = _RATE**2 * (self._sent - q) + 2.0 * _RATE * (speed - data.qvel[self._rates])
        torque[self._motors] = inertia * off[self._motors] + gravity[self._motors]
        for i, actuator in self._own.items():
            if not actuator.stiffness:
                data.ctrl[actuator.number] = torque[i] / (actuator.gear * actuator.gain)
                continue
            wanted = actuator.input_for(q[i], self._sent[i], speed[i])
            if actuator.integrates:
                wanted = (wanted - data.act[actuator.state]) / h
            data.ctrl[actuator.number] = wanted

    def _free_inertia(self) -> FloatArray:
        """Return the inertia of each joint, kg m² or kg, with all other joints free."""
        units = np.eye(self._model.nv)[self._rates[self._motors]]
        solved = np.empty_like(units)
        mujoco().mj_solveM(self._model, self._data, solved, units)
        return np.asarray(1.0 / (solved * units).sum(axis=1))

    def _gravity(self) -> FloatArray:
        """Return the bias torque of each joint (n,), N m or N, less the compensation of the file."""
        return np.array((self._data.qfrc_bias - self._data.qfrc_gravcomp)[self._rates])

    def _heaviest(self, rendered: RenderedModel) -> tuple[FloatArray, float]:
        """Return the maximum inertia (n,) of each joint, kg m² or kg, and the maximum gravity torque, N m."""
        mj, rng, arm = mujoco(), np.random.default_rng(0), rendered.scene.arm
        low, high = (np.clip(limit, -math.pi, math.pi) for limit in (arm.limits.lower, arm.limits.upper))
        data, turning = rendered.begin(self._model, arm.q_reference), ~arm.prismatic
        unit, moved = np.eye(self._model.nv), np.zeros(self._model.nv)
        inertia, load = np.zeros(len(low)), 0.0
        for q in rng.uniform(low, high, (_POSTURES, len(low))):
            data.qpos[self._places] = q
            mj.mj_forward(self._model, data)
            for i, rate in enumerate(self._rates):
                mj.mj_mulM(self._model, data, moved, unit[rate])
                inertia[i] = max(inertia[i], moved[rate])
            load = max(load, float(np.abs(data.qfrc_bias[self._rates][turning]).max(initial=0.0)))
        return inertia, load


def _take(model: Any, joint: int, *, keep: bool) -> _Actuator | None:
    """The actuator of a file that drives a joint; None if there is none, or none is to be kept.

    Those that are not kept are put out of action.
    """
    mj = mujoco()
    actuators = []
    for number in range(model.nu):
        moves = mj.mjtTrn(int(model.actuator_trntype[number])) in (
            mj.mjtTrn.mjTRN_JOINT,
            mj.mjtTrn.mjTRN_JOINTINPARENT,
        )
        if moves and int(model.actuator_trnid[number, 0]) == joint:
            if not keep:
                model.actuator_gainprm[number], model.actuator_biasprm[number] = 0.0, 0.0
                continue
            actuators.append(_actuator(model, number))
    # One that follows lengths comes first, then one that follows speeds, which otherwise damps, then a motor.
    return min(
        actuators,
        key=lambda actuator: ([b != 0.0 for b in actuator.bias[1:]] + [True]).index(True),
        default=None,
    )


def _actuator(model: Any, number: int) -> _Actuator:
    """An actuator of a file; an InputError if it is none that can be driven here."""
    mj = mujoco()
    dyn = mj.mjtDyn
    taken = (dyn.mjDYN_NONE, dyn.mjDYN_INTEGRATOR, dyn.mjDYN_FILTER, dyn.mjDYN_FILTEREXACT)
    biases = (mj.mjtBias.mjBIAS_NONE, mj.mjtBias.mjBIAS_AFFINE)
    gain = float(model.actuator_gainprm[number, 0])
    bias, dynamics = (
        mj.mjtBias(int(model.actuator_biastype[number])),
        dyn(int(model.actuator_dyntype[number])),
    )
    if (
        mj.mjtGain(int(model.actuator_gaintype[number])) != mj.mjtGain.mjGAIN_FIXED
        or bias not in biases
        or dynamics not in taken
        or gain == 0.0
    ):
        name = model.actuator(number).name or number
        raise InputError(
            f"robot.mjcf: actuator {name} is no motor, position, velocity or intvelocity servo: set "
            "plant.options.servo: position, which moves the joints without it"
        )
    affine = bias == mj.mjtBias.mjBIAS_AFFINE
    constant, by_length, by_speed = model.actuator_biasprm[number, :3].tolist() if affine else (0.0, 0.0, 0.0)
    return _Actuator(
        number,
        int(model.actuator_actadr[number]),
        dynamics == dyn.mjDYN_INTEGRATOR,
        float(model.actuator_gear[number, 0]),
        gain,
        (constant, by_length, by_speed),
    )
