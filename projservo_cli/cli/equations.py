"""Register of the equations of [RH00]: number, title, functions, tests, and errata.

Functions are dotted names, so that listing them imports nothing; a test resolves each.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class _Entry:
    """One equation, or a statement of a section where the number starts with ``§``."""

    number: str
    title: str
    functions: tuple[str, ...]  # dotted names of what implements it
    tests: tuple[str, ...]  # ``file::name`` of those that show it holds
    erratum: str  # the misprint and its correction; may be empty


def _entry(number: str, title: str, functions: str, tests: str = "", erratum: str = "") -> _Entry:
    """An entry from names separated by spaces, below the package and the folder of tests."""
    run = tuple(f"projservo_cli.{name}" for name in functions.split())
    return _Entry(number, title, run, tuple(f"tests/{name}" for name in tests.split()), erratum)


REGISTER = (
    _entry(
        "1",
        "Images of a projective point in both cameras, and its reconstruction",
        "geometry.kinematics.row geometry.kinematics.project geometry.stereo.triangulate",
        "geometry/test_kinematics.py::test_pixels_of_points "
        "geometry/test_stereo.py::test_clean_points_are_recovered",
    ),
    _entry(
        "2",
        "Projective displacement, conjugate to a rigid motion, of unit determinant",
        "geometry.displacements.normalize_displacement",
        "geometry/test_displacement.py::test_scale_of_a_homography_keeps_points_on_their_side_of_infinity",
        "det = 1 leaves ±H in dimension 4 (the trace is 0 at 180°): choose the sign that keeps the sign "
        "of a_inf·M.",
    ),
    _entry(
        "3",
        "Duals: the point that three planes meet in, planes of a point or line",
        "geometry.algebra.meet geometry.algebra.dual_pencil",
        "geometry/test_algebra.py::test_meet_is_the_determinant_with_one_row_open",
    ),
    _entry(
        "4",
        "Projective rotation: algebra to group and group to algebra",
        "geometry.displacements.rotation calibration.projective.closed_form_operators "
        "geometry.displacements.displacements",
        "geometry/test_displacement.py::test_rotation_is_the_matrix_exponential "
        "calibration/test_contract_structure.py::test_the_closed_form_finds_the_same_operators_without_noise",
        "Group to algebra is undefined at 0 and ±π: such trial motions are refused.",
    ),
    _entry(
        "5",
        "Projective translation: algebra to group and group to algebra",
        "geometry.displacements.translation calibration.projective.closed_form_operators "
        "geometry.displacements.displacements",
        "geometry/test_displacement.py::test_translation_is_the_matrix_exponential "
        "calibration/test_contract_structure.py::test_the_closed_form_finds_the_same_operators_without_noise",
        "Group to algebra is undefined at 0: such trial motions are refused.",
    ),
    _entry(
        "6",
        "Forward kinematics as a product of exponentials",
        "geometry.kinematics.forward geometry.kinematics.forward_between calibration.prediction.moved_points",
        "geometry/test_kinematics.py::test_forward_kinematics_is_the_product_of_exponentials",
    ),
    _entry(
        "7",
        "Velocity of a projective point and of its image",
        "geometry.kinematics.image_velocity calibration.prediction.projection_derivative",
        "geometry/test_kinematics.py::test_image_jacobian_is_the_derivative_of_the_pixels",
        "The second row of J_G is printed as 1/m3, 0, …; it is 0, 1/m3, −m2/m3².",
    ),
    _entry(
        "8",
        "Translation along an axis through two points",
        "geometry.mechanisms.translation_mechanism",
        "geometry/test_mechanisms.py::test_translation_keeps_every_plane_through_its_line",
    ),
    _entry(
        "9",
        "Revolution about an axis through two points",
        "geometry.mechanisms.rotation_mechanism",
        "geometry/test_mechanisms.py::test_revolution_keeps_its_axis",
        "“ker” is missing: q̂_R ν = ker[…]. The text says plane-operators; they are point operators.",
    ),
    _entry(
        "10",
        "Revolution about a point in a plane",
        "geometry.mechanisms.planar_mechanism",
        "geometry/test_mechanisms.py::test_planar_revolution_keeps_its_plane_and_its_point",
        "Scrambled in typesetting: the rows are −Ĥ_iᵀ a_1 and Ĥ_i A_1.",
    ),
    _entry(
        "11",
        "Amplitude of the translation of the centre",
        "task.partition.translation_part",
        "task/test_partition.py::test_amplitudes_are_the_metric_ones",
    ),
    _entry(
        "12",
        "Target less the translation",
        "task.partition.partition",
        "task/test_partition.py::test_any_displacement "
        "task/test_partition.py::test_partition_does_not_depend_on_the_frame",
    ),
    _entry(
        "13",
        "Rotation onto the plane: the circle of a point meets the target plane",
        "task.partition.onto_plane_part",
        "task/test_partition.py::test_amplitudes_are_the_metric_ones",
        "The axis lies in a_t, so p_0 = 0 and θ⁻ = θ⁺ ± π. For the optical centre |p_0| may exceed the "
        "amplitude: visibility then never changes, which is no error.",
    ),
    _entry(
        "14",
        "Its trigonometric equation",
        "task.visibility.margin_coefficients",
        "task/test_visibility.py::test_margin_coefficients_describe_the_carried_plane",
    ),
    _entry(
        "15",
        "The two solutions of the trigonometric equation",
        "geometry.algebra.incidence_angles",
        "geometry/test_composition.py::test_solutions_are_all_zeros_of_the_equation "
        "geometry/test_composition.py::test_the_printed_second_solution_holds_only_without_a_cosine",
        "θ⁻ = π − θ⁺ holds only where p_c = 0; θ± = atan2(p_s, p_c) ± arccos(−p_0 / √(p_s² + p_c²)).",
    ),
    _entry(
        "16",
        "Target less the translation and the rotation onto the plane",
        "task.partition.partition",
        "task/test_partition.py::test_any_displacement task/test_partition.py::test_square_face",
    ),
    _entry(
        "17",
        "Displacement along the planned trajectory",
        "task.trajectory.displaced",
        "task/test_trajectory.py::test_planned_displacement_is_the_product_in_the_order_of_the_paper",
    ),
    _entry(
        "18",
        "Shares of translation and rotations along the trajectory",
        "task.trajectory.profile_shares",
        "task/test_trajectory.py::test_shares_grow_from_nothing_to_all",
        "μ_d is μ_t.",
    ),
    _entry(
        "19",
        "Joint operators of the moving robot",
        "geometry.kinematics.operators_at",
        "geometry/test_kinematics.py::test_operators_are_conjugated_by_the_joints_before "
        "geometry/test_kinematics.py::test_operators_are_the_derivatives_of_the_forward_kinematics",
        "The operator is conjugated by the truncated product H̄_i(q_g) of (6), not by H_i⁰.",
    ),
    _entry(
        "20",
        "Direct control directTHREE",
        "control.direct.direct_three",
        "control/test_direct.py::test_each_error_decays_at_its_own_rate",
        "−ė = λe with q̇ = […] ė leads away from the goal; the motion that reaches it is q̇ = λ_t τ "
        "q̂_t + λ_r θ_r q̂_r + λ_p θ_p q̂_p.",
    ),
    _entry(
        "21",
        "Displacement that directTHREE integrates to",
        "control.direct.direct_three",
        "acceptance/test_paper_task.py::test_drift_falls_with_the_gain_and_with_the_limit",
        "λ_r θ_r is printed twice; the second is λ_p θ_p.",
    ),
    _entry(
        "22",
        "Translation and rotation at once",
        "control.direct.direct_two control.direct.exact",
        "acceptance/test_paper_task.py::test_drift_falls_with_the_gain_and_with_the_limit "
        "control/test_exact.py::test_the_centre_keeps_to_its_line",
        "exp(τĤ_t) exp(θĤ_s) = exp(τĤ_t + θĤ_s) holds only to first order, or where the translation is "
        "parallel to the axis; with Ĥ_s carried along with the moving centre the flow integrates to the "
        "product.",
    ),
    _entry(
        "23",
        "Direct control directTWO",
        "control.direct.direct_two control.law.single_rotation",
        "control/test_direct.py::test_one_rotation_decays_at_the_rate_of_its_gain "
        "control/test_direct.py::test_any_ratio_converges",
        "Sign as in (20): q̇ = λ_t τ q̂_t + λ_s θ_s q̂_s.",
    ),
    _entry(
        "24",
        "One rotation for both rotations",
        "geometry.displacements.composed_angle geometry.displacements.composed_operator",
        "geometry/test_composition.py::test_one_rotation_equals_two "
        "control/test_direct.py::test_error_of_both_rotations_is_the_true_angle",
    ),
    _entry(
        "25",
        "Coefficients of the composed rotation",
        "geometry.displacements.composed_angle",
        "geometry/test_composition.py::test_the_printed_factor_two_is_wrong",
        "c = sin(θ_p/2) sin(θ_r/2), without the factor 2, with [Ĥ_r, Ĥ_p] = Ĥ_r Ĥ_p − Ĥ_p Ĥ_r.",
    ),
    _entry(
        "§4.2",
        "Visibility and the motions that do not change it",
        "planning.margins._visibility task.visibility.visibility_translation "
        "task.visibility.visibility_angles task.visibility.choose_sense "
        "task.visibility.limited_translation",
        "task/test_visibility.py::test_neutral_along_the_ray_of_a_point_of_the_face "
        "task/test_visibility.py::test_neutral_parallel_to_the_face_and_within_its_plane "
        "task/test_visibility.py::test_neutral_about_any_axis_through_the_optical_center "
        "task/test_visibility.py::test_the_optical_axis_itself_is_not_neutral "
        "task/test_visibility.py::test_sense_of_the_turn_by_brute_force",
        "Translation along the optical axis changes visibility unless the ray passes through the face's "
        "point. Neutral, for one camera each: translation along that ray in front of the camera or "
        "parallel to the face, any rotation about an axis through the optical centre, and Ĥ_p.",
    ),
    _entry(
        "§4.3",
        "Profiles of the trajectory, and the coupled constraint on translation and rotation",
        "task.trajectory.profile_shares planning.product_space.plan_path",
        "planning/test_product_space.py::test_the_shipped_task_needs_coupled_parts "
        "task/test_trajectory.py::test_linear_and_exponential "
        "task/test_trajectory.py::test_what_comes_first_is_done_before_the_rest_begins",
        "1 − exp(−σ/t_*) reaches 0.632 at σ = t_* and is normalised to reach 1. H_r(θ_P(σ)) is "
        "H_r(θ_r(σ)); “μ_t < τ_0” compares τ(σ) with τ_0, likewise θ_r; τ(σ − 1) means τ (μ_t(σ) − 1).",
    ),
)
