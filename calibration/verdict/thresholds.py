"""Every limit that a table is judged by, in one list, each with its reason and where the number comes from.

Rules that hold inside:

- A value within `accept` is accepted; between `accept` and `refuse` it is remarked on; beyond `refuse` there is no
  table.
- A limit without `refuse` is only ever remarked on: what it measures does not make the table wrong.
- Where a measurement refuses by itself (`calibration.registration.register`), the number is defined there and imported.
- Numbers that `acquire check` or the live judge use as well stand in `experiment.limits.table`.
"""

from __future__ import annotations

from dataclasses import dataclass

from calibration.registration.register import (
    MAX_BLOCK_RESIDUAL_PX,
    MAX_TAG_RESIDUAL_PX,
    MIN_AGREEMENT,
    MIN_GOOD_BLOCKS,
)
from experiment.limits.table import TABLE_LIMITS, Sense
from experiment.measures.sensor import MAX_BLACK_DRIFT

JUDGEMENT = "judgement"
"""The source of a limit that nothing but experience supports."""

SIMULATED = "measured on simulated frames"
"""The source of a limit found in rooms whose truth is known (`benchmarks.rooms`, `benchmarks.accuracy`)."""


@dataclass(frozen=True)
class Threshold:
    """One limit.

    - `name`: of the value that it judges, as in `report.json`.
    - `title`: the value for people.
    - `unit`: of the value and both limits; "" for a count or a plain number, "share" for 0 … 1.
    - `sense`: on which side of the limits a value is accepted.
    - `accept`: up to here nothing is remarked.
    - `refuse`: beyond it no table is made; None where the value is only ever remarked on.
    - `why`: what goes wrong beyond.
    - `source`: where the number comes from.
    - `remedy`: what to do about it; "" where it depends on the cause (`calibration.verdict.wording`).
    """

    name: str
    title: str
    unit: str
    sense: Sense
    accept: float
    refuse: float | None
    why: str
    source: str
    remedy: str


_FLATTEN = "hang the print flatter"
_FIX = "fix camera and print, and let nobody walk about"
_LESS_VEIL = (
    "take frames of red, green and blue alone and a chart of more colours, use the lens's hood, hang black cloth "
    "around the print, and keep lights and bright walls out of its view"
)
_WARM_UP = "let the lamp warm up for longer before the session"

THRESHOLDS: tuple[Threshold, ...] = (
    Threshold(
        "tags_found", "Tags found", *TABLE_LIMITS["tags_found"].numbers,
        "where a tag is missing, the place of the cells around it rests on the cells alone", JUDGEMENT,
        "bring all of the chart into the picture, and uncover it",
    ),
    Threshold(
        "cell_px", "Shorter side of a cell", *TABLE_LIMITS["cell_px"].numbers,
        "25 pixels reach 3.25 px from a cell's centre, rounding and registration included",
        "geometry: half of 5 px, 0.5 px rounding, 0.25 px registration; 8.6 px bleeds 1.3 % at a blur of 0.7 px",
        "bring the camera nearer or take a longer lens",
    ),
    Threshold(
        "bleed", "Light of neighbouring cells in the worst sample", *TABLE_LIMITS["bleed"].numbers,
        "the lens's blur mixes neighbouring cells into the outermost of the window's pixels",
        "normal integral beyond the cell's edge at 0.75 px misplacement; 0.2 % is a sharp lens at 10 px a cell",
        "focus on the print, stop down to f/8, bring the camera nearer, or take a smaller window (build-lut --window)",
    ),
    Threshold(
        "correction_residual", "Light of surroundings that may be left in cells' means", "share", "at most", 0.01, 0.03,
        "what the lens spreads, or may spread as a veil that an evenly lit print cannot show, is in the samples",
        SIMULATED + ": 0.1 to 0.2 % where light falls off towards the corners, and the means are as good; 1.4 % in "
        "even light or on a chart of 512 colours, which do not show a veil of the usual 1 %",
        _LESS_VEIL,
    ),
    Threshold(
        "correction_worst", "The same in the cell that it is largest of", "share", "at most", 0.03, None,
        "a veil adds as much to dark cells as to bright ones, so that dark ones are off by several times the mean",
        "geometry: by a cell of a twentieth of paper six times the veil's error; 3 % is three standard deviations of "
        "a mean of 300 counts; " + SIMULATED + ": 0.3 to 1.9 % where the mean is accepted",
        _LESS_VEIL,
    ),
    Threshold(
        "tag_residual_px", "Residual of tags, plane and lens", "px RMS", "at most", 2.5, MAX_TAG_RESIDUAL_PX,
        "the place of a sheet that waves more rests on its cells alone",
        SIMULATED + ": 6 mm of waves and 10 mm of curl give 2.3",
        _FLATTEN,
    ),
    Threshold(
        "tag_final_px", "Residual of tags, final map", "px RMS", "at most", 0.4, 2.0,
        "cells and tags disagree about where the print is; the limits are for cells of 10 px and rise with their size",
        SIMULATED + ": 0.05 to 0.2, the detector's own error 0.09",
        "check that chart.json is that of the print, and that the print is one flat sheet",
    ),
    Threshold(
        "block_residual_px", "Residual of cell blocks", "px RMS", "at most", 0.1, MAX_BLOCK_RESIDUAL_PX,
        "cells are sampled beside their centres; the limits are for cells of 10 px and rise with their size",
        SIMULATED + ": 0.01 to 0.06", _FLATTEN,
    ),
    Threshold(
        "blocks_good", "Cell blocks that match the chart", "share", "at least", 0.98, MIN_GOOD_BLOCKS,
        "part of the print is covered, damaged, or another print", JUDGEMENT, "uncover the print, or print it anew",
    ),
    Threshold(
        "agreement", "Correlation of cells and chart", "", "at least", 0.97, MIN_AGREEMENT,
        "the colours are not those of the chart", SIMULATED + ": 0.99 and more; another order of the cells has about 0",
        "name the chart.json of this print, and print without colour management",
    ),
    Threshold(
        "unfit_share", "Cells unfit for use", *TABLE_LIMITS["unfit_share"].numbers,
        "colours without samples are missing from every picture", JUDGEMENT, "",
    ),
    Threshold(
        "doubtful_share", "Cells in surroundings 1 % off their codes' colours", *TABLE_LIMITS["doubtful_share"].numbers,
        "the print, or the light on it, is not the same there as elsewhere; from 2 % on its cells are listed as unfit",
        SIMULATED + ": none on a clean flat print", "clean the print, hang it flatter, and look for shadows on it",
    ),
    Threshold(
        "added_light", "Light added to a large part of the print, of paper white",
        *TABLE_LIMITS["added_light"].numbers,
        "it is the same on dark cells as on bright ones, and goes on beyond those that are listed as unfit",
        SIMULATED + ": 0 in healthy rooms; 1 % of paper makes cells of a tenth of paper 10 % brighter, and those of a "
        "thirtieth 30 %; a reflection of 3 % leaves a table with cells 57 % off",
        "turn print or projector until nothing is mirrored on it, or print on matt paper",
    ),
    Threshold(
        "softer_bleed", "Light of neighbouring cells added in the most blurred frame", "share", "at most", 0.003, 0.012,
        "a frame is out of focus, or was shaken; only white frames are checked cell by cell for such light",
        SIMULATED + ": 0.9 px of blur in one frame of a session with 0.5 px give 0.8 % and cells 1.2 % off, "
        "1.1 px 2 % and cells 4 % off",
        "switch off autofocus and stabilisation, see that nothing shakes the camera",
    ),
    Threshold(
        "unlike_scatter", "Scatter of cells about their codes' colours, worst frame", "share", "at most", 0.012, 0.03,
        "the frame's samples are not of their cells' colours",
        SIMULATED + ": to 0.8 % beyond noise; a blur of 1.1 px gives 1.4 %, 1.5 px 5 %, another print 50 %",
        "see that nothing changes during the session",
    ),
    Threshold(
        "unlike_block", "Deviation of the worst block of cells, worst frame", "share", "at most", 0.01, 0.03,
        "something lay, or shone, on the print in that frame or in the one compared with, and its samples contain it",
        SIMULATED + ": to 0.4 % beyond noise",
        "see that nobody comes between lamp, print and camera",
    ),
    Threshold(
        "disturbed_cells", "Cells next to each other that are far off in a light's frame", "", "at most", 0, None,
        "their samples under that light are not of their own colours; they are listed as unfit, and the other cells "
        "are not touched",
        SIMULATED + ": none in healthy rooms; two cells next to each other, five standard deviations off, are one, "
        "unless the dark frames show them to be hot",
        "see that nothing comes between lamp, print and camera",
    ),
    Threshold(
        "moved_anew", "Frames registered again", "", "at most", 0, None,
        "the chart or the camera moved between frames; the sampling grid followed", JUDGEMENT, _FIX,
    ),
    Threshold(
        "other_camera", "Frames of another camera", "", "at most", 0, 0.5,
        "a table is of one camera: another body sees other colours, and another model others yet", "by definition",
        "take these frames again with the session's camera",
    ),
    Threshold(
        "other_lens", "Frames through another lens", "", "at most", 0, None,
        "lenses tint, blur and shade each in its own way", "by definition",
        "take these frames again through the session's lens",
    ),
    Threshold(
        "other_exposure", "Exposure of a frame against that of most, as the files state it", "share", "at most",
        0.01, 0.1,
        "brightness would differ between lights that should be alike, and the noise with the ISO speed",
        "shutter times are steps of 26 % apart, and are written rounded",
        "keep one exposure and ISO speed for the session, and take these frames again",
    ),
    Threshold(
        "other_iso", "Frames of another ISO speed", "", "at most", 0, None,
        "their noise is another, and so is the count at which they saturate; their exposure is judged apart",
        "by definition",
        "keep one exposure and ISO speed for the session, and take these frames again",
    ),
    Threshold(
        "white_frames", "White frames", "", "at least", 1, None,
        "nothing says how the lamp drifted, whether the print has stains, or whether cells are of one colour",
        "by definition; from two on a drift is seen",
        "take white frames along with the lights (sequence.reference_every)",
    ),
    Threshold(
        "black_drift_counts", "Drift of the black level", "counts", "at most", MAX_BLACK_DRIFT, 16.0,
        "the sensor warmed up; each frame's own black is subtracted, but an error of it shows in dark cells of about "
        "30 counts",
        JUDGEMENT, "let the camera run for some minutes before the session, and rest between frames",
    ),
    Threshold(
        "white_drift", "Drift of paper white between white frames", *TABLE_LIMITS["white_drift"].numbers,
        "lights taken at other times differ in brightness; each has its own ground truth, so its colour is right",
        JUDGEMENT + "; 1 % between whites is usual for a warm lamp", _WARM_UP,
    ),
    Threshold(
        "drift_left", "Drift that white frames leave open, where it is taken out", "share", "at most", 0.002, 0.005,
        "between two white frames the lamp jumps or flickers, and a light there is given another brightness than it "
        "had; its own ground truth goes along, so its colour is right",
        SIMULATED + ": 0.1 % of a steady drift on a small chart; a jump of 1 % leaves 0.5 %",
        "build the table without --correct-drift, let the lamp warm up, or take white frames more often "
        "(sequence.reference_every)",
    ),
    Threshold(
        "white_drift_deg", "Drift of white's colour", *TABLE_LIMITS["white_drift_deg"].numbers,
        "the lamp's spectrum changes, not its brightness alone",
        JUDGEMENT + ": a tenth of a good method's error", _WARM_UP,
    ),
    Threshold(
        "leak_share", "Light while the projector shows black, relative to white", *TABLE_LIMITS["leak_share"].numbers,
        "every light contains this much of the projector's leak and the room's light, so that deep colours are paler",
        JUDGEMENT + "; a contrast of 1 : 1500 leaks 0.07 %",
        "darken the room, cover lamps and displays, or have it subtracted (build-lut --subtract-dark)",
    ),
    Threshold(
        "dark_drift", "Change of that light between dark frames, relative to white",
        *TABLE_LIMITS["dark_drift"].numbers,
        "the room's light changes; what is subtracted, or part of each light, is not what was there",
        JUDGEMENT + ": a hundredth of a cell of a fifth of white", "darken the room, and keep daylight out",
    ),
    Threshold(
        "stray_share", "Light in some frames that no dark frame shows, of white", "share", "at most", 0.004, 0.01,
        "a light contains it, or a primary that others are made of, so that deep colours are paler under some lights "
        "than under others; subtracting dark frames does not help",
        SIMULATED + ": below 0.1 % in healthy rooms; 1 % of white makes the darkest cells 10 % brighter, and puts deep "
        "lights 1 to 2 degrees off, which is a good method's error",
        "darken the room, see that no door, lamp or display changes during the session, switch power saving and "
        "dynamic contrast off, and take the frames again",
    ),
    Threshold(
        "linearity", "Deviation from linearity, 5 to 95 % of saturation", *TABLE_LIMITS["linearity"].numbers,
        "counts are not proportional to light, so that chromaticities change with brightness",
        "EMVA 1288 asks for the range; 1 % is " + JUDGEMENT,
        "expose less, switch the camera's highlight priority off, and take the series in steady light",
    ),
    Threshold(
        "additivity", "White against the sum of the primaries", *TABLE_LIMITS["additivity"].numbers,
        "a light cannot be predicted from its codes: the projector brightens or converts white, or frames are not what "
        "they are called, or exposed otherwise",
        JUDGEMENT + "; the drift of the lamp is taken out first",
        "switch off brilliant colour, white boost and dynamic contrast in the projector's menu",
    ),
    Threshold(
        "white_short", "White short of the sum of the primaries", "share", "at most", 0.05, 0.3,
        "no wheel takes light away: a frame of white or of a primary was exposed otherwise, or the projector holds "
        "full white back",
        JUDGEMENT + "; a lamp that flickers by 1 % gives 2 %",
        "look at the exposures of these frames, and switch dynamic contrast and power saving off",
    ),
    Threshold(
        "off_codes_deg", "White of a light against what its codes predict", *TABLE_LIMITS["off_codes_deg"].numbers,
        "a frame bears another light's name, or was taken before the picture changed: codes in the table are not those "
        "of its whites",
        SIMULATED + ": 0 in random healthy rooms; a list of frames shifted by a row gives 28 and more, an exchange of "
        "two lights the angle between them",
        "correct the list of frames that was imported, let the picture settle for longer (sequence.settle_s), or "
        "expose whole turns of the colour wheel",
    ),
    Threshold(
        "off_brightness", "Brightness of a light against what its codes predict", "share", "at most", 0.1, 0.3,
        "a frame was exposed otherwise than its file states, or another light; brightness differs between lights that "
        "should be alike",
        JUDGEMENT + ": lamps flicker by some per cent, the next shutter time is 26 % off",
        "keep one exposure for the session, and take the frames again",
    ),
    Threshold(
        "exchanged_lights", "Pairs of lights that bear each other's names", "", "at most", 0, None,
        "their whites fit their codes when exchanged and not as they are; each ground truth is measured and right, "
        "but its codes and temperature are the other's",
        SIMULATED + ": none in random healthy rooms, all pairs further apart than the figure below in the others",
        "correct the list of frames that was imported, or take both again",
    ),
    Threshold(
        "code_misfit", "Disagreement of few lights with their codes, all together", "", "at most", 1.0, None,
        "no projector makes these whites of these codes, whichever light it is that is wrong",
        SIMULATED + ": 1 is what random healthy rooms stay below; of more than 24 lights each is judged by itself",
        "look whether frames and lights belong together, and whether the lamp was steady",
    ),
    Threshold(
        "exchange_deg", "Angle down to which exchanged names are excluded", "°", "at most", 8.0, None,
        "two lights less far apart than this could bear each other's names unnoticed",
        SIMULATED + ": 0.3 with 707 lights, 0 with eight that lie far apart",
        "take white and the primaries along with the lights, and expose longer",
    ),
    Threshold(
        "held_share", "Lights that could be held against their codes", "share", "at least", 0.9, None,
        "of the others nothing says that they bear their own names",
        "the angle from which a wrong name is refused, beyond what codes predict of so few lights",
        "take white, red, green and blue along with the lights, and expose longer",
    ),
    Threshold(
        "white_frame_deg", "White frame against what the lights predict", "°", "at most", 2.0, 8.0,
        "the frame shows another light than white, or the lights bear wrong names",
        SIMULATED + ": 0 in random healthy rooms",
        "correct the list of frames that was imported, or take the white frame again",
    ),
    Threshold(
        "white_frame_brightness", "Brightness of the white frame against what the lights predict", "share", "at most",
        0.1, 0.3,
        "the white frame was exposed otherwise than the lights, so that drift and stray light are read wrongly",
        JUDGEMENT + ": lamps flicker by some per cent, the next shutter time is 26 % off",
        "keep one exposure for the session, and take the white frame again",
    ),
    Threshold(
        "primaries_lacking", "Primaries without a frame of their own", "", "at most", 0, None,
        "the fields of the primaries were not measured, so that coloured cells are evened by the field of paper",
        "where the primaries' fields differ by 10 %, coloured cells at corners are off by some tenths of a per cent",
        "take red, green and blue, each alone, along with the lights",
    ),
    Threshold(
        "grey_tint_deg", "Tint of the print's greys against paper", *TABLE_LIMITS["grey_tint_deg"].numbers,
        "greys are not neutral; the ground truth is paper's, so methods that rely on grey are judged by another grey",
        JUDGEMENT + "; simulated prints have 1 to 2.5 through the printer's profile, 4.5 (poster paper) to 8 (glossy) "
        "where codes are ink codes, as the publication printed them",
        "generate with --rendering colorimetric, which takes the print as it is measured; or have the chart printed "
        "through the printer's profile (docs/printing.md)",
    ),
    Threshold(
        "noise_misfit", "Cells' noise about the photon-transfer curve", "share", "at most", 0.3, None,
        "there is scatter that light and sensor do not explain: the camera smooths its raw files, or the light "
        "flickers",
        "EMVA 1288 model; " + SIMULATED + ": 0.05 to 0.15", "switch the camera's noise reduction off",
    ),
    Threshold(
        "noisy_share", "Cells noisier than their level explains", "share", "at most", 0.002, 0.1,
        "they are not of one colour: dirt, a fold, a neighbour's edge", "a variance 3.5 times the model's",
        "clean the print, focus, and hang it flatter",
    ),
    Threshold(
        "references_used", "White references used, worst frame", *TABLE_LIMITS["references_used"].numbers,
        "flat field and ground truth rest on few places", JUDGEMENT,
        "uncover the print, bring all of it into the picture, expose so that bare paper stays below saturation",
    ),
    Threshold(
        "reference_spread", "White references about the flat field, under white",
        *TABLE_LIMITS["reference_spread"].numbers,
        "what is not smooth, or falls off otherwise than lenses do, is left in the samples by the flat field",
        SIMULATED + ": 0.3 % of noise and photosites' response",
        "clean or flatten the print, and look for shadows on it",
    ),
    Threshold(
        "truth_median_deg", "Standard error of the ground truth, median light", "°", "at most", 0.1, 1.0,
        "a method's error cannot be measured finer than the ground truth is known",
        JUDGEMENT + ": good methods are 1 to 2 degrees off", "expose longer",
    ),
    Threshold(
        "truth_worst_deg", "Standard error of the ground truth, worst light", "°", "at most", 0.5, 3.0,
        "under that light a method's error cannot be measured finer than the ground truth is known", JUDGEMENT,
        "expose longer, or leave the darkest lights out",
    ),
    Threshold(
        "brightest_share", "Bare paper under the brightest light, of saturation",
        *TABLE_LIMITS["brightest_share"].numbers,
        "the unevenness of the light carries cells into saturation",
        JUDGEMENT + ": 0.8 leaves room for 20 % unevenness",
        "expose less",
    ),
    Threshold(
        "darkest_counts", "Bare paper under the darkest light", *TABLE_LIMITS["darkest_counts"].numbers,
        "25 samples of 300 counts have a mean good to 1 %, a print's dark colours a thirtieth of that",
        "photon noise at 1.8 electrons a count, 6 counts of read noise", "expose longer",
    ),
)  # fmt: skip
"""The limits, in the order of the report."""
