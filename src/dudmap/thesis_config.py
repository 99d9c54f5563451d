"""Parameters of the thesis' system (``dudmap.thesis``), with the values of chapters 4 and 6."""

from typing import Literal

from pydantic import Field

from dudmap.config_section import ConfigSection


class ThesisConfig(ConfigSection):
    """Parameters of the thesis' system. Values without a section are not in the thesis."""

    similarity: float = Field(default=0.84, gt=0, le=1)
    """Similarity of consecutive images above which the later one is skipped (section 4.3); 1 skips none."""
    lowe_ratio: float = Field(default=0.8, gt=0, lt=1)
    """Nearest over second nearest descriptor distance of a good match (Lowe 2004, section 7.1; thesis: "RATIO")."""

    depth_min: float = Field(default=0.2, ge=0)
    """Smallest used depth, metres."""
    depth_max: float = Field(default=6.0, gt=0)
    """Largest used depth, metres."""
    alpha: float = Field(default=12.0, gt=0)
    """Range standard deviation of the filter at 1 m, millimetres (eq. 4.11). Reading: 12 has no unit; in metres the
    filter would average over all depths."""
    sigma_s: float = Field(default=4.0, gt=0)
    """Spatial standard deviation of the filter, pixels (section 4.3)."""
    filter_radius: int = Field(default=8, ge=1, le=32)
    """Half width of the filter window N(u_k), pixels: two standard deviations."""

    tau: float = Field(default=0.01, gt=0, le=1)
    """Voxel size, metres (table 6.1)."""
    d_max: float = Field(default=0.1, gt=0)
    """Largest distance stored in front of a surface, metres; no number in the thesis. Three standard deviations of a
    Kinect at 4 m, and more than ``theta``, so that points in free space can be dynamic."""
    d_min: float = Field(default=0.1, gt=0)
    """Largest distance stored behind a surface, metres."""
    w_max: int = Field(default=255, ge=1, le=255)
    """Largest weight W_max of the running average (eq. 4.19); a voxel stores it in one byte (section 4.5)."""
    empty_after: int = Field(default=4, ge=1, le=200)
    """Frames that must see a block empty before it is free ("empty in enough time", section 7.1)."""

    upsilon: float = Field(default=0.1325, ge=0)
    """Weight of the intensity term relative to the distance term (eq. 4.32, table 6.2)."""
    estimator: Literal["huber", "tukey"] = "huber"
    """Robust weight rho (eq. 4.44, 4.45)."""
    rho: float = Field(default=0.01, gt=0)
    """Constant rho_h or rho_t of the estimator, metres (table 6.1)."""
    damping: Literal["gramian", "identity"] = "gramian"
    """Damping by lambda J^T J (eq. 4.42) or lambda I (eq. 4.41)."""
    lambda_0: float = Field(default=0.02, ge=0)
    """Initial damping factor lambda (table 6.1)."""
    iterations: int = Field(default=5, ge=1)
    """Largest number of iterations per level (algorithm 2)."""
    stop: float = Field(default=1e-3, gt=0)
    """Norm of the pose increment that ends a level, metres and radians (algorithm 2)."""
    subsample: Literal["quarter", "original"] = "quarter"
    """Pixels of the finest level: a quarter of the image or all (table 4.2)."""
    levels: int = Field(default=3, ge=1, le=5)
    """Number of pyramid levels, coarse to fine (section 4.4)."""

    theta: float = Field(default=0.03, ge=0)
    """Smallest difference delta_L of a dynamic point to the static map, metres (eq. 4.57)."""
    em_iterations: int = Field(default=30, ge=1)
    """Largest number of EM iterations (algorithm 3)."""
    em_stop: float = Field(default=1e-4, gt=0)
    """Relative increment of the likelihood that ends the EM (algorithm 3)."""
