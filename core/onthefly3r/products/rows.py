"""One row per photograph, the source of the camera shapefile, the trajectory and the preview."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timezone
from math import hypot
from typing import Literal

from ..geometry.frames import gimbal_angles_deg, omega_phi_kappa_deg
from ..records import PlacedCamera, Shot

Xyz = tuple[float, float, float]


@dataclass(frozen=True)
class CameraRow:
    """A photograph in the export frame; names as in the shapefile, lengths in m, angles in degrees."""

    image: str
    number: int  # shot index + 1: point source id in the cloud, IMAGE_ID in the COLMAP model
    status: Literal["placed", "rejected"]
    reason: str = ""  # why it was rejected
    x: float | None = None  # position of a placed camera, export frame
    y: float | None = None
    z: float | None = None
    omega: float | None = None  # photogrammetric angles in the grid
    phi: float | None = None
    kappa: float | None = None
    yaw: float | None = None  # gimbal angles: yaw from true north clockwise, pitch -90 at nadir
    pitch: float | None = None
    roll: float | None = None
    gps_x: float | None = None  # tagged position, export frame
    gps_y: float | None = None
    gps_z: float | None = None
    sig_h: float | None = None  # standard deviation of the tagged position that was used
    sig_v: float | None = None
    sd_h: float | None = None  # standard deviation of the adjusted camera, m per horizontal axis
    sd_v: float | None = None  # m
    sd_deg: float | None = None  # per angle
    rtk: int | None = None  # DJI RtkFlag
    used: bool = False  # the tagged position took part in georeferencing
    retries: int = 0
    batch: int | None = None
    part: int | None = None  # of the map: what nothing connects lies in different parts
    t_utc: str = ""  # ISO 8601, in the camera's own clock
    cam: str = ""  # camera key

    @property
    def dx(self) -> float | None:
        """East of the tagged position, m."""
        return _difference(self.x, self.gps_x)

    @property
    def dy(self) -> float | None:
        """North of the tagged position, m."""
        return _difference(self.y, self.gps_y)

    @property
    def dz(self) -> float | None:
        """Above the tagged position, m."""
        return _difference(self.z, self.gps_z)

    @property
    def d_h(self) -> float | None:
        """Horizontal distance from the tagged position, m."""
        return None if self.dx is None or self.dy is None else hypot(self.dx, self.dy)

    @property
    def d_3d(self) -> float | None:
        """Distance from the tagged position, m."""
        return None if self.dx is None or self.dy is None or self.dz is None else hypot(self.dx, self.dy, self.dz)

    @property
    def position(self) -> Xyz | None:
        """Where the camera is placed, else where its tags put it (height 0 where they have none), else None."""
        if self.x is not None and self.y is not None and self.z is not None:
            return self.x, self.y, self.z
        if self.gps_x is not None and self.gps_y is not None:
            return self.gps_x, self.gps_y, self.gps_z or 0.0
        return None


def placed_row(
    camera: PlacedCamera,
    shot: Shot,
    *,
    gps: tuple[float, float, float | None] | None = None,
    sigma_h_m: float | None = None,
    sigma_v_m: float | None = None,
    used: bool = False,
    convergence_deg: float = 0.0,
) -> CameraRow:
    """Return the row of a placed photograph.

    Args:
        camera: pose in the export frame.
        shot: the photograph it belongs to.
        gps: tagged position in the export frame, m; the height may be missing.
        sigma_h_m: horizontal standard deviation of it that was used.
        sigma_v_m: vertical standard deviation of it that was used.
        used: it took part in georeferencing.
        convergence_deg: meridian convergence at the camera (true to grid north, clockwise); yaw counts from true north.
    """
    rotation = camera.world_from_cam.rotation
    x, y, z = (float(value) for value in camera.world_from_cam.translation)
    omega, phi, kappa = omega_phi_kappa_deg(rotation)
    yaw, pitch, roll = gimbal_angles_deg(rotation)
    gps_x, gps_y, gps_z = gps or (None, None, None)
    return CameraRow(
        image=shot.name,
        number=camera.index + 1,
        status="placed",
        x=x,
        y=y,
        z=z,
        omega=omega,
        phi=phi,
        kappa=kappa,
        yaw=(yaw + convergence_deg + 180.0) % 360.0 - 180.0,
        pitch=pitch,
        roll=roll,
        gps_x=gps_x,
        gps_y=gps_y,
        gps_z=gps_z,
        sig_h=sigma_h_m,
        sig_v=sigma_v_m,
        rtk=shot.gps.rtk if shot.gps else None,
        used=used,
        retries=camera.retries,
        batch=camera.batch,
        part=camera.part,
        t_utc=_iso_time(shot.time_s),
        cam=shot.camera_key,
    )


def rejected_row(
    shot: Shot, number: int, reason: str, *, gps: tuple[float, float, float | None] | None = None, retries: int = 0
) -> CameraRow:
    """Return the row of a photograph that was not placed; `number` is its shot index + 1, `gps` as in `placed_row`."""
    gps_x, gps_y, gps_z = gps or (None, None, None)
    return CameraRow(
        image=shot.name,
        number=number,
        status="rejected",
        reason=reason,
        gps_x=gps_x,
        gps_y=gps_y,
        gps_z=gps_z,
        rtk=shot.gps.rtk if shot.gps else None,
        retries=retries,
        t_utc=_iso_time(shot.time_s),
        cam=shot.camera_key,
    )


def _difference(a: float | None, b: float | None) -> float | None:
    return None if a is None or b is None else a - b


def _iso_time(time_s: float | None) -> str:
    if time_s is None:
        return ""
    return datetime.fromtimestamp(time_s, timezone.utc).isoformat(timespec="milliseconds").replace("+00:00", "Z")
