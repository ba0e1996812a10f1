"""Settings of the depth camera and of its errors.

By default a perfect camera at the hand's viewpoint.
"""

from dataclasses import dataclass, field, replace

from vd.assets_usd.hand_data import HandModel
from vd.command.config import require
from vd.paper import PAPER

BASELINE_M, FOCAL_PX = 0.055, 1024.2
"""Distance of the imagers of an Intel RealSense D415 [m] (D400 series data sheet), and their focal
length [pixel] where disparities are found: 1280 pixels over 64 degrees."""
LATENCY_S = (1.0 / 30.0, 2.0 / 30.0)
"""Age of images at 30 Hz, as vd-deploy asks for [s]: one period to take and send, and up to one
until it is read (an assumption; the data sheet gives none)."""
ABOVE_M = 0.12
"""Points count up to so far above where objects are handled [m]: with the D'Claw up to its palm."""
POSITION_NOISE_M, ROTATION_NOISE_RAD = 0.001, 0.002
"""What a calibration leaves of the camera's place along and about each axis: 2 mm in the median at
an object half a metre away, as of 20 views of one finger."""


@dataclass(frozen=True)
class DepthSensorCfg:
    """Errors of a stereo depth camera. All are off: zero."""

    disparity_std_px: float = 0.0
    """Noise of the disparity [pixel]; in depth it is z^2 / (focal length * baseline) times that.
    Real cameras of this kind: 0.05 to 0.1."""
    disparity_step_px: float = 0.0
    """Rounding of the disparity [pixel]; the D400 series resolves 1/32."""
    shadow: bool = False
    """No depth where the second imager, a baseline to the right, sees nothing: left of near things,
    and along the left border of the image."""
    edge_jump_m: float = 0.02
    """Difference of depth between neighbouring pixels that makes an edge [m]."""
    edge_dropout: float = 0.0
    """Share of edge pixels that have no depth."""
    flying: float = 0.0
    """Share of edge pixels that lie somewhere between the two surfaces."""
    dropout: float = 0.0
    """Share of all pixels that have no depth."""
    min_range_m: float = 0.0
    """Depth below which there is none [m]; a D415 sees from 0.45 m on at 1280 x 720."""

    @staticmethod
    def realistic() -> "DepthSensorCfg":
        """Much like a D415: its noise, rounding and shadow, frayed edges, a least distance."""
        return DepthSensorCfg(
            disparity_std_px=0.08,
            disparity_step_px=1.0 / 32.0,
            shadow=True,
            edge_dropout=0.3,
            flying=0.1,
            dropout=0.005,
            min_range_m=0.3,
        )

    @property
    def uses_edges(self) -> bool:
        """Whether edge pixels are treated apart."""
        return self.edge_dropout > 0.0 or self.flying > 0.0

    @property
    def enabled(self) -> bool:
        """Whether anything is measured otherwise than it is."""
        errors = self.disparity_std_px, self.disparity_step_px, self.dropout, self.min_range_m
        return self.uses_edges or self.shadow or any(value > 0.0 for value in errors)

    def validate(self) -> None:
        """Raise ValueError naming the field and the remedy."""
        require(
            self, "sensor.", "zero or positive", "disparity_std_px disparity_step_px min_range_m"
        )
        require(self, "sensor.", "positive", "edge_jump_m")
        require(self, "sensor.", "in [0, 1]", "edge_dropout flying dropout")
        if self.edge_dropout + self.flying > 1.0:
            raise ValueError(
                f"sensor.edge_dropout + sensor.flying = {self.edge_dropout + self.flying}; "
                "together they must not exceed 1"
            )


@dataclass(frozen=True)
class DepthCameraCfg:
    """A depth camera on the hand's base in every environment."""

    points: int = PAPER.camera.points
    """Points of a cloud at most; 0 makes no clouds."""
    crop_m: tuple[float, float] = PAPER.camera.crop_m
    """Least and largest height over the table of a cloud's points [m]."""
    position_noise_m: float = 0.0
    """Standard deviation of the camera's position along each axis [m], one draw an environment;
    clouds do not know."""
    rotation_noise_rad: float = 0.0
    """Standard deviation of its orientation about each axis [rad], likewise."""
    place_range: tuple[float, float] = (0.0, 0.0)
    """Up to how far the camera is from its place along [m], and turned about [rad], each of its own
    axes, one even draw an environment; clouds know."""
    latency_s: tuple[float, float] = (0.0, 0.0)
    """Range of the images' age [s], drawn evenly for each environment."""
    sensor: DepthSensorCfg = field(default_factory=DepthSensorCfg)
    """Errors of the measured depth."""

    @classmethod
    def of_hand(cls, hand: HandModel) -> "DepthCameraCfg":
        """The same camera for a hand: its points reach as far above where objects are handled."""
        crop_m = PAPER.camera.crop_m[0], hand.workspace.goal_m[2] + ABOVE_M
        return cls(crop_m=crop_m)

    def with_errors(self) -> "DepthCameraCfg":
        """The same camera as a D415.

        Its sensor's errors, late images, not quite where it is believed.
        """
        return replace(
            self,
            sensor=DepthSensorCfg.realistic(),
            latency_s=LATENCY_S,
            position_noise_m=POSITION_NOISE_M,
            rotation_noise_rad=ROTATION_NOISE_RAD,
        )

    def validate(self) -> None:
        """Raise ValueError naming the field and the remedy."""
        self.sensor.validate()
        require(self, "", "zero or positive", "points position_noise_m rotation_noise_rad")
        if self.crop_m[0] > self.crop_m[1]:
            raise ValueError(f"crop_m = {self.crop_m}; name the lower height first")
        if not 0.0 <= self.latency_s[0] <= self.latency_s[1]:
            raise ValueError(
                f"latency_s = {self.latency_s}; name two times, none negative, the least first"
            )
