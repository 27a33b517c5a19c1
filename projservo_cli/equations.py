"""Register of the equations of [RH00]: number, title, functions, tests, and what is misprinted.

Functions are dotted names, so that listing them imports nothing; a test resolves each.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Entry:
    """One equation, or a statement of a section where the number starts with ``§``."""

    number: str
    title: str
    functions: tuple[str, ...]
    tests: tuple[str, ...] = ()
    erratum: str = ""


_GEOMETRY = "projservo_cli.geometry."

_TASK = "projservo_cli.task."
_CONTROL = "projservo_cli.control."

REGISTER = (
    Entry(
        "1",
        "Images of a projective point in both cameras, and its reconstruction",
        (
            _GEOMETRY + "kinematics.project",
            _GEOMETRY + "stereo.triangulate",
            _GEOMETRY + "stereo.triangulate_points",
        ),
    ),
    Entry(
        "2",
        "Projective displacement, conjugate to a rigid motion, of unit determinant",
        (_GEOMETRY + "displacement.normalize_displacement",),
        (),
        "det = 1 leaves ±H in dimension 4 (the trace is 0 at 180°): choose the sign that keeps the sign of "
        "a_inf·M.",
    ),
    Entry(
        "3",
        "Duals: the point that three planes meet in, planes of a point or line",
        (_GEOMETRY + "algebra.meet",),
    ),
    Entry(
        "4",
        "Projective rotation: algebra to group and group to algebra",
        (
            _GEOMETRY + "displacement.rotation",
            _GEOMETRY + "displacement.exp_rotation",
            _GEOMETRY + "displacement.log_rotation",
        ),
        (),
        "Group to algebra is undefined at 0 and ±π: such trial motions are refused.",
    ),
    Entry(
        "5",
        "Projective translation: algebra to group and group to algebra",
        (
            _GEOMETRY + "displacement.translation",
            _GEOMETRY + "displacement.exp_translation",
            _GEOMETRY + "displacement.log_translation",
        ),
        (),
        "Group to algebra is undefined at 0: such trial motions are refused.",
    ),
    Entry(
        "6",
        "Forward kinematics as a product of exponentials",
        (_GEOMETRY + "kinematics.forward", _GEOMETRY + "kinematics.forward_kinematics"),
    ),
    Entry(
        "7",
        "Velocity of a projective point and of its image",
        (_GEOMETRY + "kinematics.image_jacobian",),
        (),
        "The second row of J_G is printed as 1/m3, 0, …; it is 0, 1/m3, −m2/m3².",
    ),
    Entry("8", "Translation along an axis through two points", (_GEOMETRY + "mechanisms.translation_along",)),
    Entry(
        "9",
        "Revolution about an axis through two points",
        (_GEOMETRY + "mechanisms.rotation_about",),
        (),
        "“ker” is missing: q̂_R ν = ker[…]. The text says plane-operators; they are point operators.",
    ),
    Entry(
        "10",
        "Revolution about a point in a plane",
        (_GEOMETRY + "mechanisms.rotation_within",),
        (),
        "Scrambled in typesetting: the rows are −Ĥ_iᵀ a_1 and Ĥ_i A_1.",
    ),
    Entry("11", "Amplitude of the translation of the centre", (_TASK + "partition.partition",)),
    Entry("12", "Target less the translation", (_TASK + "partition.partition",)),
    Entry(
        "13",
        "Rotation onto the plane: the circle of a point meets the target plane",
        (_TASK + "partition.onto_plane_part",),
        (),
        "The axis lies in a_t, so p_0 = 0 and θ⁻ = θ⁺ ± π. For the optical centre |p_0| may exceed the "
        "amplitude: visibility then never changes, which is no error.",
    ),
    Entry("14", "Its trigonometric equation", (_TASK + "partition.onto_plane_part",)),
    Entry(
        "15",
        "The two solutions of the trigonometric equation",
        (_TASK + "visibility.visibility_angles",),
        (),
        "θ⁻ = π − θ⁺ holds only where p_c = 0; θ± = atan2(p_s, p_c) ± arccos(−p_0 / √(p_s² + p_c²)).",
    ),
    Entry(
        "16", "Target less the translation and the rotation onto the plane", (_TASK + "partition.partition",)
    ),
    Entry("17", "Displacement along the planned trajectory", (_TASK + "trajectory.trajectory_displacement",)),
    Entry(
        "18",
        "Shares of translation and rotations along the trajectory",
        (_TASK + "trajectory.profile_shares",),
        (),
        "μ_d is μ_t.",
    ),
    Entry(
        "19",
        "Joint operators of the moving robot",
        (_GEOMETRY + "kinematics.operators_at", _GEOMETRY + "kinematics.joint_operators"),
        (),
        "The operator is conjugated by the truncated product H̄_i(q_g) of (6), not by H_i⁰.",
    ),
    Entry(
        "20",
        "Direct control directTHREE",
        (_CONTROL + "direct_three.direct_three",),
        (),
        "−ė = λe with q̇ = […] ė leads away from the goal; the motion that reaches it is "
        "q̇ = λ_t τ q̂_t + λ_r θ_r q̂_r + λ_p θ_p q̂_p.",
    ),
    Entry(
        "21",
        "Displacement that directTHREE integrates to",
        (_CONTROL + "direct_three.direct_three",),
        (),
        "λ_r θ_r is printed twice; the second is λ_p θ_p.",
    ),
    Entry(
        "22",
        "Translation and rotation at once",
        (_CONTROL + "direct_two.direct_two",),
        (),
        "exp(τĤ_t) exp(θĤ_s) = exp(τĤ_t + θĤ_s) holds only to first order, or where the translation is "
        "parallel to the axis; with Ĥ_s carried along with the moving centre the flow integrates to the "
        "product.",
    ),
    Entry(
        "23",
        "Direct control directTWO",
        (_CONTROL + "direct_two.direct_two",),
        (),
        "Sign as in (20): q̇ = λ_t τ q̂_t + λ_s θ_s q̂_s.",
    ),
    Entry("24", "One rotation for both rotations", (_GEOMETRY + "composition.compose_rotations",)),
    Entry(
        "25",
        "Coefficients of the composed rotation",
        (_GEOMETRY + "composition.compose_rotations",),
        (),
        "c = sin(θ_p/2) sin(θ_r/2), without the factor 2, with [Ĥ_r, Ĥ_p] = Ĥ_r Ĥ_p − Ĥ_p Ĥ_r.",
    ),
    Entry(
        "§4.2",
        "Visibility and the motions that do not change it",
        (
            _TASK + "visibility.margin",
            _TASK + "visibility.visibility_translation",
            _TASK + "visibility.choose_sense",
        ),
        (),
        "Translation along the optical axis changes visibility unless the ray passes through the face's "
        "point. Neutral, for one camera each: translation along that ray in front of the camera or parallel "
        "to the face, any rotation about an axis through the optical centre, and Ĥ_p.",
    ),
    Entry(
        "§4.3",
        "Profiles of the trajectory",
        (_TASK + "trajectory.profile_shares",),
        (),
        "1 − exp(−σ/t_*) reaches 0.632 at σ = t_* and is normalised to reach 1. H_r(θ_P(σ)) is H_r(θ_r(σ)); "
        "“μ_t < τ_0” compares τ(σ) with τ_0, likewise θ_r; τ(σ − 1) means τ (μ_t(σ) − 1).",
    ),
)
