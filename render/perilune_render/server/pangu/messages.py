"""The messages of PANGU's wire protocol 1.20: number, name, layout of the payload, and this server's response.

A layout has a letter for each field: u unsigned integer, b bool, f float, d double; a number repeats the letter after
it. The layout of an array describes one item. The fixed fields contain the number of items (`count_of`). Source: the
facts listed in docs/reference/pangu.md.
"""

from dataclasses import dataclass
from typing import Literal

VERSION = 0x0114
"""Version 1.20 as on the wire: major x 256 + minor."""
PORT = 10363
"""Default port of PANGU's clients."""
Effect = Literal["answered", "read", "refused"]
"""Response to a message.

answered: it has an effect or returns a value; read: it is acknowledged without effect; refused: it returns an error.
"""


@dataclass(frozen=True, slots=True)
class Message:
    """A message of a client."""

    number: int
    """Number on the wire; settings begin at 256."""
    name: str
    """PANGU's name."""
    fields: str
    """Layout of the fixed fields."""
    item: str = ""
    """Layout of one item of the array that follows; empty if there is none."""
    effect: Effect = "answered"
    """How the server responds."""
    note: str = ""
    """Effect of the message on this server, for the documentation."""


OKAY, ERROR, IMAGE, FLOAT, FLOAT_ARRAY, POINT, POINT_ARRAY = range(7)
ECHO, LIDAR_PULSE, DOUBLE, DOUBLE_ARRAY, JOINTS, FRAMES, CAMERA, RAW_IMAGE = 8, 9, 12, 13, 14, 15, 16, 17
"""Numbers of the server's messages."""
GOODBYE, QUIT = 0, 27
FIRST_SETTING = 256

_SCAN = "the scans of a lidar are not simulated"
_NO_OBJECT = "there are no moving objects"
_LIGHT = "has no effect: the Sun is the only light, and the configuration sets its radiance"
_SKY = "has no effect: the sky is black"

_ALL = (
    Message(0, "Goodbye", "", note="ends the session, without a reply"),
    Message(1, "GetImage", "", note="image of the current camera"),
    Message(2, "GetElevation", "", note="height of the camera above ground or boulder below it"),
    Message(3, "GetElevations", "u", "3f", note="heights of given positions above ground or boulders"),
    Message(4, "LookupPoint", "2f", note="point of the surface at a position in the image"),
    Message(5, "LookupPoints", "u", "2f", note="points of the surface at several positions in the image"),
    Message(6, "GetPoint", "3f", note="point of the surface in a direction of the world from the camera"),
    Message(7, "GetPoints", "u", "3f", note="points of the surface in several directions"),
    Message(8, "Echo", "u", "b", note="the bytes come back"),
    Message(9, "GetRangeImage", "2f", note="ranges from the camera, in 256 grey values"),
    Message(10, "GetRangeTexture", "", note="the 256 grey values of a range image"),
    Message(11, "GetViewpointByDegreesS", "6f", note="sets the viewpoint; image"),
    Message(12, "GetViewpointByQuaternionS", "7f", note="sets the viewpoint; image"),
    Message(13, "GetLidarPulseResult", "6f", note="range and cosine of incidence; 0 and 0 for a miss"),
    Message(14, "GetLidarMeasurement", "25f", effect="refused", note=_SCAN),
    Message(15, "GetRadarResponse", "4u4f3f3f4ff13u", effect="refused", note="a radar is not simulated"),
    Message(16, "GetViewpointByDegreesD", "6d", note="sets the viewpoint; image"),
    Message(17, "GetViewpointByQuaternionD", "7d", note="sets the viewpoint; image"),
    Message(18, "GetJoints", "u", note=f"empty list: {_NO_OBJECT}"),
    Message(19, "GetJointConfig", "2u", note=f"nine zeros: {_NO_OBJECT}"),
    Message(20, "GetFrames", "u", note=f"empty list: {_NO_OBJECT}"),
    Message(21, "GetFrame", "2u", note=f"twelve zeros: {_NO_OBJECT}"),
    Message(22, "GetFrameAsRadians", "2u", note=f"six zeros: {_NO_OBJECT}"),
    Message(23, "GetSurfaceElevation", "b2f", note="height of the ground, or of boulders on it"),
    Message(24, "GetSurfaceElevations", "bu", "2f", note="heights at several positions"),
    Message(25, "GetSurfacePatch", "b2f2u2f", note="heights on a rotated grid"),
    Message(26, "GetViewpointByRadians", "6d", note="sets the viewpoint; image"),
    Message(27, "Quit", "", note="ends the server with --allow-quit; else an error"),
    Message(28, "GetViewpointByFrame", "2u", note=f"image of size 0: {_NO_OBJECT}"),
    Message(29, "GetCameraProperties", "u", note="cameras 0 and 1 are one camera; others do not exist"),
    Message(30, "GetViewpointByCamera", "u", note="image of camera 0 or 1; of size 0 for others"),
    Message(31, "GetViewAsDEM", "ub2u3f", note="heights towards the camera on a grid across its axis"),
    Message(32, "GetLidarMeasurementD", "25d", effect="refused", note=_SCAN),
    Message(33, "GetTimeTag", "", note="time of the request for the last image that was sent"),
    Message(34, "GetLidarMeasurementS", "25f", effect="refused", note=_SCAN),
    Message(35, "GetLidarSnapshot", "u7d", note="range, cosine of incidence and hit of each pixel"),
    Message(256, "SetViewpointByDegreesS", "6f"),
    Message(257, "SetViewpointByQuaternionS", "7f"),
    Message(258, "SetAmbientLight", "3f", effect="read", note=_LIGHT),
    Message(259, "SetSunColour", "3f", effect="read", note=_LIGHT),
    Message(260, "SetSkyType", "u", effect="read", note=_SKY),
    Message(261, "SetFieldOfViewByDegrees", "f", note="horizontal field of view"),
    Message(262, "SetAspectRatio", "f", note="height of a pixel over its width, as angles"),
    Message(263, "SetBoulderView", "ub", effect="read", note="has no effect: boulders are always drawn"),
    Message(264, "SetSurfaceView", "u2b", effect="read", note="has no effect: the ground is always drawn in full"),
    Message(265, "SetLidarParameters", "32u", effect="read", note=_SCAN),
    Message(266, "SetCornerCubesS", "3u", "7f", effect="read", note="has no effect: there are no reflectors"),
    Message(267, "SetCornerCubeAttitude", "13f", effect="read", note="has no effect: there are no reflectors"),
    Message(268, "SetViewpointByDegreesD", "6d"),
    Message(269, "SetViewpointByQuaternionD", "7d"),
    Message(270, "SetObjectPositionAttitude", "u7d", effect="read", note=f"has no effect: {_NO_OBJECT}"),
    Message(271, "SetSunByDegrees", "3d", note="direction of the Sun; the distance has no effect"),
    Message(272, "SetJointConfig", "3u", "db", effect="read", note=f"has no effect: {_NO_OBJECT}"),
    Message(273, "SetStarQuaternion", "4d", effect="read", note=_SKY),
    Message(274, "SetStarMagnitudes", "d", effect="read", note=_SKY),
    Message(275, "SetSecondaryByDegrees", "3d", effect="read", note=_LIGHT),
    Message(276, "SetGlobalTime", "d", effect="read", note="has no effect: nothing moves"),
    Message(277, "SetObjectView", "2u", effect="read", note=f"has no effect: {_NO_OBJECT}"),
    Message(278, "SetViewpointByRadians", "6d"),
    Message(279, "SetFieldOfViewByRadians", "f", note="horizontal field of view"),
    Message(280, "SetSunByRadians", "3d", note="direction of the Sun; the distance has no effect"),
    Message(281, "SetSecondaryByRadians", "3d", effect="read", note=_LIGHT),
    Message(282, "SetSkyRGB", "3f", effect="read", note=_SKY),
    Message(283, "SetSkyCIE", "3f", effect="read", note=_SKY),
    Message(284, "SetAtmosphereTau", "6f", effect="read", note="has no effect: the Moon has no atmosphere"),
    Message(285, "SetGlobalFogMode", "u", effect="read", note="has no effect: the Moon has no atmosphere"),
    Message(286, "SetGlobalFogProperties", "4d", effect="read", note="has no effect: the Moon has no atmosphere"),
    Message(287, "SetAtmosphereMode", "3u", effect="read", note="has no effect: the Moon has no atmosphere"),
    Message(288, "SelectCamera", "u", note="0 or 1, the same camera; an error for others"),
    Message(289, "BindLightToCamera", "2ub", effect="read", note=_LIGHT),
    Message(290, "ConfigureLightByDegrees", "u15f", effect="read", note=_LIGHT),
    Message(291, "ConfigureLightByRadians", "u15f", effect="read", note=_LIGHT),
    Message(292, "SetLightPositionDirection", "u6d", effect="read", note=_LIGHT),
    Message(293, "RenderToHoldBuffer", "2u", effect="read", note="has no effect: there is no window"),
    Message(294, "DisplayHoldBuffer", "u", effect="read", note="has no effect: there is no window"),
    Message(295, "SetCornerCubesD", "3u", "7d", effect="read", note="has no effect: there are no reflectors"),
    Message(296, "SetProjectionMode", "2u", note="0 (perspective) for cameras 0 and 1; else an error"),
    Message(297, "SetOrthoFieldOfView", "u2d", effect="read", note="has no effect: the projection is perspective"),
    Message(298, "SetLidarScan", "3u", "8d", effect="read", note=_SCAN),
    Message(299, "SetCameraMotion", "u18d", note="velocity up to 12 km/s blurs images; other motion has no effect"),
)
MESSAGES = {message.number: message for message in _ALL}
"""All messages that a client may send, by number."""
COUNTED_FIRST = (266, 295, 298)
"""Numbers of the messages whose first field is the item count: reflectors and scans."""


def count_of(message: Message, values: list) -> int:
    """Number of items of a message's array, from the values of its fixed fields."""
    if message.number in COUNTED_FIRST:
        return int(values[0])
    return int(values[-1])
