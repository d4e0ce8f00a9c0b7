"""XMP packets by a plain scan for names and values: what is not quite XML still says what it says.

Drones and geotagging programs write packets with undeclared prefixes, bare ampersands, stray bytes, bytes around the
packet, or several packets. A scan needs no well-formed document, expands no entities and does not recurse.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping

MAX_PACKET_BYTES = 1 << 20
MAX_VALUES = 4000
MAX_DEPTH = 32
MAX_VALUE_CHARACTERS = 1000

# Prefixes are free to choose; the names below are the usual ones, whatever the packet calls them.
NAMESPACES: Mapping[str, str] = {
    "http://www.dji.com/drone-dji/1.0/": "drone-dji",
    "http://www.autel.com/drone/1.0/": "drone",
    "http://www.autelrobotics.com/drone/1.0/": "drone",
    "http://pix4d.com/camera/1.0": "Camera",
    "http://pix4d.com/camera/1.0/": "Camera",
    "http://ns.sensefly.com/Camera/1.0/": "Camera",
    "http://www.parrot.com/drone-parrot/1.0/": "drone-parrot",
    "https://www.skydio.com/drone-skydio/1.0/": "drone-skydio",
    "http://www.skydio.com/drone-skydio/1.0/": "drone-skydio",
    "http://www.yuneec.com/drone-yuneec/1.0/": "drone-yuneec",
    "http://ns.google.com/photos/1.0/panorama/": "GPano",
    "http://ns.adobe.com/exif/1.0/": "exif",
    "http://ns.adobe.com/tiff/1.0/": "tiff",
    "http://ns.adobe.com/xap/1.0/": "xmp",
}

# Bounded repetitions that start at a boundary: the scan takes time in proportion to the packet, whatever it holds.
_TOKEN = re.compile(
    r"""<(?P<close>/?)(?P<element>[\w.-]{1,60}:[\w.-]{1,60})
      | (?<![\w.-])(?P<attribute>[\w.-]{1,60}:[\w.-]{1,60})\s{0,8}=\s{0,8}(?:"(?P<double>[^"<]*)"|'(?P<single>[^'<]*)')
    """,
    re.VERBOSE,
)
_REST = re.compile(r"[^<>]*>(?P<text>[^<]*)")
_COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)


def parse_xmp(packets: bytes | Iterable[bytes]) -> dict[str, str]:
    """Return {prefix:name: value} of attributes and text elements; of equal names the first counts.

    A field of a structure is found under `prefix:structure/name` too. Known namespaces go by their usual prefix.
    """
    values: dict[str, str] = {}
    for packet in [packets] if isinstance(packets, bytes) else packets:
        _scan(_text(packet[:MAX_PACKET_BYTES]), values)
    return values


def _text(packet: bytes) -> str:
    for mark, encoding in ((b"\xff\xfe", "utf-16-le"), (b"\xfe\xff", "utf-16-be")):
        if packet.startswith(mark):
            return packet.decode(encoding, "replace")
    return packet.decode("utf-8", "replace")


def _scan(text: str, values: dict[str, str]) -> None:
    if "-->" in text:
        text = _COMMENT.sub(" ", text)
    usual: dict[str, str] = {}  # declared prefix -> usual prefix
    parents: list[str] = []
    for token in _TOKEN.finditer(text):
        if len(values) >= MAX_VALUES:
            return
        if token["attribute"]:
            value = token["double"] if token["double"] is not None else token["single"]
            prefix, name = token["attribute"].split(":", 1)
            if prefix == "xmlns":
                if value in NAMESPACES:
                    usual[name] = NAMESPACES[value]
            elif prefix not in ("rdf", "x", "xml"):
                _keep(values, f"{usual.get(prefix, prefix)}:{name}", parents[-1] if parents else "", value)
            continue
        prefix, name = token["element"].split(":", 1)
        key = f"{usual.get(prefix, prefix)}:{name}"
        if token["close"]:
            if key in parents:
                del parents[len(parents) - 1 - parents[::-1].index(key) :]
            continue
        rest = _REST.match(text, token.end())
        content = rest["text"].strip() if rest else ""
        if content:
            _keep(values, key, parents[-1] if parents else "", content)
        elif prefix not in ("rdf", "x") and len(parents) < MAX_DEPTH:
            parents.append(key)


def _keep(values: dict[str, str], key: str, parent: str, value: str) -> None:
    value = value.strip()[:MAX_VALUE_CHARACTERS]
    values.setdefault(key, value)
    if parent and parent != key:
        values.setdefault(f"{parent}/{key.split(':', 1)[1]}", value)
