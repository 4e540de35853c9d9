"""In which group of the report each figure stands: what a scientist asks about, one question a group."""

from __future__ import annotations

from typing import Final, Literal, get_args

Group = Literal["geometry", "light", "radiometry", "noise", "truth"]
GROUPS: Final[tuple[Group, ...]] = get_args(Group)

QUESTIONS: Final[dict[Group, str]] = {
    "geometry": "Was the chart found, and does each sample lie in its cell?",
    "light": "Is each light the one that was ordered, alone, and of one lamp?",
    "radiometry": "Are counts proportional to light, and cells their codes' colours?",
    "noise": "Is the noise that of light and sensor?",
    "truth": "How well is each light's colour known?",
}

_THRESHOLDS: Final[dict[Group, tuple[str, ...]]] = {
    "geometry": (
        "tags_found", "cell_px", "bleed", "softer_bleed", "tag_residual_px", "tag_final_px", "block_residual_px",
        "blocks_good", "agreement", "moved_anew",
    ),
    "light": (
        "white_drift", "drift_left", "white_drift_deg", "leak_share", "dark_drift", "stray_share", "additivity",
        "white_short", "off_codes_deg", "off_brightness", "exchanged_lights", "code_misfit", "exchange_deg",
        "held_share", "white_frame_deg", "white_frame_brightness", "white_frames", "primaries_lacking",
    ),
    "radiometry": (
        "correction_residual", "correction_worst", "unfit_share", "doubtful_share", "added_light", "disturbed_cells",
        "unlike_scatter", "unlike_block", "other_camera", "other_lens", "other_exposure", "other_iso",
        "black_drift_counts", "linearity", "grey_tint_deg", "brightest_share", "darkest_counts",
    ),
    "noise": ("noise_misfit", "noisy_share"),
    "truth": ("references_used", "reference_spread", "truth_median_deg", "truth_worst_deg"),
}  # fmt: skip

OF_THRESHOLDS: Final[dict[str, Group]] = {name: group for group, names in _THRESHOLDS.items() for name in names}
"""Group of each limit of `calibration.verdict.thresholds`, by name."""

OF_SUMMARY: Final[dict[str, Group]] = {
    **dict.fromkeys(("Drift of white", "Lights against their codes", "Lights held against their codes"), "light"),
    **dict.fromkeys(("Fields of the primaries", "Light that no dark frame shows"), "light"),
    **dict.fromkeys(("Red + green + blue − white", "Light while the projector shows black"), "light"),
    **dict.fromkeys(("Spread of the lens", "Black level", "Saturation", "Darkest light", "Linearity"), "radiometry"),
    **dict.fromkeys(("Tint of the greys", "Cells unfit for use"), "radiometry"),
    **dict.fromkeys(("Noise of a sample", "Photon transfer", "Samples at 0"), "noise"),
    "Standard error of the ground truth": "truth",
}
"""Group of rows of `calibration.report.page`, by name; all others are geometry."""


def group_of_row(name: str) -> Group:
    """Return the group of a row of the summary."""
    return OF_SUMMARY.get(name, "geometry")
