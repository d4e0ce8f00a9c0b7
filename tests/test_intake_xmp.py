"""XMP that is not quite XML still says what it says; nothing is expanded, and the scan is linear."""

from __future__ import annotations

import time

import pytest

from onthefly3r.intake.tags import Tags
from onthefly3r.intake.xmp import MAX_PACKET_BYTES, MAX_VALUES, parse_xmp

DJI = 'xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/"'
HEIGHT, FLAG = 'drone-dji:AbsoluteAltitude="+198.60"', 'drone-dji:RtkFlag="50"'


def packet(attributes: str, inside: str = "", namespaces: str = DJI) -> bytes:
    return (
        '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?><x:xmpmeta xmlns:x="adobe:ns:meta/">'
        '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description rdf:about="" '
        f'{namespaces} {attributes}>{inside}</rdf:Description></rdf:RDF></x:xmpmeta><?xpacket end="w"?>'
    ).encode()


WHOLE = packet(f"{HEIGHT} {FLAG}")


@pytest.mark.parametrize(
    "data",
    [
        WHOLE,
        packet(f"{HEIGHT} {FLAG}", namespaces='xmlns:drone-djj="http://www.dji.com/drone-dji/1.0/"'),
        packet(f'drone-dji:SensorID="A&B" {HEIGHT} {FLAG}'),
        packet(f'drone-dji:SelfData="Stra\xdfe" {HEIGHT} {FLAG}').replace("\xdf".encode(), b"\xdf"),
        packet(f'drone-dji:SelfData="\x01\x0c" {HEIGHT} {FLAG}'),
        packet(f'{HEIGHT} {FLAG} drone-dji:AbsoluteAltitude="7"'),
        packet(f"{HEIGHT} {FLAG}", inside="<a:b>unclosed"),
        WHOLE[: WHOLE.index(b"</rdf:Description>")],
        WHOLE[: WHOLE.index(b'"50"') + 4],
        b"xml:XMP=" + WHOLE,
        b"\0\0junk" + WHOLE + b"\0" * 60 + b"junk",
        WHOLE.decode().encode("utf-16"),
        packet(f"{HEIGHT} {FLAG}".replace('"', "'")),
        packet(f"{HEIGHT} {FLAG}".replace("=", " = ")),
        packet("", "<drone-dji:AbsoluteAltitude>+198.60</drone-dji:AbsoluteAltitude>\n<drone-dji:RtkFlag> 50 </a:b>"),
        packet("", '<drone-dji:AbsoluteAltitude a:b="c">+198.60</drone-dji:AbsoluteAltitude><drone-dji:RtkFlag>50'),
        packet(f"{HEIGHT} {FLAG}".replace("drone-dji", "d"), namespaces=DJI.replace("drone-dji=", "d=")),
        packet("drone-dji:X='<!--'") + packet(f"{HEIGHT} {FLAG}"),
    ],
    ids=[
        "as it should be", "undeclared prefix", "bare ampersand", "Latin-1 byte", "control characters",
        "repeated attribute", "unclosed element", "truncated", "cut in the middle", "GDAL's prefix", "bytes around it",
        "UTF-16", "single quotes", "spaces about the sign", "elements", "elements with attributes", "another prefix",
        "two packets",
    ],
)  # fmt: skip
def test_known_names_are_read(data: bytes) -> None:
    tags = Tags(xmp=parse_xmp(data))
    assert tags.xmp_number("drone-dji:AbsoluteAltitude") == 198.6
    assert tags.xmp_number("drone-dji:RtkFlag") == 50


def test_several_packets_and_comments() -> None:
    found = parse_xmp([packet(FLAG), packet(HEIGHT)])
    assert (found["drone-dji:RtkFlag"], found["drone-dji:AbsoluteAltitude"]) == ("50", "+198.60")
    assert "drone-dji:RtkFlag" not in parse_xmp(packet(HEIGHT, f"<!-- {FLAG} -->"))


def test_fields_of_structures_are_told_apart() -> None:
    """Skydio writes the angles in two frames of reference, as attributes or as elements."""
    attributes = packet(
        "",
        '<drone-skydio:CameraOrientationFLU drone-skydio:Pitch="1"/>'
        '<drone-skydio:CameraOrientationNED drone-skydio:Pitch="-90"/>',
    )
    elements = packet(
        "",
        '<drone-skydio:CameraOrientationFLU rdf:parseType="Resource"><drone-skydio:Pitch>1</drone-skydio:Pitch>'
        '</drone-skydio:CameraOrientationFLU><drone-skydio:CameraOrientationNED rdf:parseType="Resource">'
        "<drone-skydio:Pitch>-90</drone-skydio:Pitch></drone-skydio:CameraOrientationNED>",
    )
    for data in (attributes, elements):
        assert parse_xmp(data)["drone-skydio:CameraOrientationNED/Pitch"] == "-90"


def test_entities_are_not_expanded() -> None:
    bomb = b'<!DOCTYPE a [<!ENTITY b "50"><!ENTITY c "&b;&b;">]>' + packet('drone-dji:RtkFlag="&c;"')
    assert Tags(xmp=parse_xmp(bomb)).xmp_number("drone-dji:RtkFlag") is None


@pytest.mark.parametrize(
    "data",
    [
        b"<a:b>" * 200_000,
        b"a" * MAX_PACKET_BYTES,
        b"a:b='" * 200_000,
        b"<" * MAX_PACKET_BYTES,
        b"<!--" * 250_000,
        b'a:b="' + b"x" * MAX_PACKET_BYTES,
        b"a:" * 500_000,
        b"".join(b'a:n%d="1" ' % k for k in range(100_000)),
        b"<a:b " * 200_000,
    ],
    ids=["nesting", "one word", "quotes", "angles", "comments", "long value", "colons", "many names", "open tags"],
)
def test_hostile_packets_take_no_time_and_no_room(data: bytes) -> None:
    start = time.process_time()
    found = parse_xmp(data + b" " * 10 + WHOLE)
    assert time.process_time() - start < 1.0
    assert len(found) <= MAX_VALUES + 1
    assert sum(map(len, found.values())) < 1 << 22
