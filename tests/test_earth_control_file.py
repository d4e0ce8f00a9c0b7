"""Ground control is read from every form that people have it in, and a wrong line is named."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from onthefly3r.earth.control_file import control_of, read_control
from onthefly3r.errors import ReferenceFormatError
from onthefly3r.options import GeoreferenceOptions

GCP_LIST = """EPSG:32633
500010.5 5400020.25 312.5 100.5 200.25 IMG_1.jpg P1
500010.5 5400020.25 312.5 150.5 210.25 IMG 2.jpg
""".replace("IMG 2.jpg\n", "IMG_2.jpg P1\n500110 5400120 300 5 6 IMG_1.jpg CHK-2\n")


def written(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def test_gcp_list(tmp_path: Path) -> None:
    control = read_control(written(tmp_path, "gcp_list.txt", "\ufeff" + GCP_LIST))
    assert control.crs == "EPSG:32633"
    assert sorted(control.points) == ["CHK-2", "P1"]
    assert control.points["CHK-2"].checkpoint and not control.points["P1"].checkpoint
    assert control.points["P1"].height_m == 312.5
    assert 48.0 < control.points["P1"].lat_deg < 49.0 and abs(control.points["P1"].lon_deg - 15.0) < 0.01
    first = control.marks[0]
    assert (first.label, first.image, first.x_px, first.y_px) == ("P1", "IMG_1.jpg", 100.5, 200.25)


def test_points_without_labels_are_told_apart_by_their_coordinates(tmp_path: Path) -> None:
    lines = [
        "WGS84 UTM 33N",
        "500010 5400020 312 1 2 a.jpg",
        "500010 5400020 312 3 4 b.jpg",
        "500099 5400020 312 3 4 b.jpg",
    ]
    control = read_control(written(tmp_path, "gcp_list.txt", "\n".join(lines)))
    assert [m.label for m in control.marks] == ["GCP1", "GCP1", "GCP2"]


def test_utm_with_tabs_and_blanks_in_names(tmp_path: Path) -> None:
    text = (
        "+proj=utm +zone=11 +datum=WGS84 +units=m +no_defs\n235269.88\t3811198.11\t0.0\t1.5\t2.5\tmy photo.jpg\tg 2\n"
    )
    control = read_control(written(tmp_path, "gcp_list.txt", text))
    assert control.crs == "EPSG:32611"
    assert control.marks[0].image == "my photo.jpg" and control.marks[0].label == "g 2"


@pytest.mark.parametrize(
    "text",
    [
        "label,x,y,z,image,px,py\nP1,500010.5,5400020.25,312.5,a.jpg,10,20\nP1,500010.5,5400020.25,312.5,b.jpg,11,21\n",
        "# EPSG:32633\n#Label;X/Easting;Y/Northing;Z/Altitude;Image;X px;Y px\n"
        "P1;500010,5;5400020,25;312,5;a.jpg;10;20\n"
        "P1;;;;b.jpg;11;21\n",
        "Name\tEasting\tNorthing\tHeight\tPhoto\tPixel X\tPixel Y\nP1\t500010.5\t5400020.25\t312.5\ta.jpg\t10\t20\n"
        "P1\t500010.5\t5400020.25\t312.5\tb.jpg\t11\t21\n",
    ],
)
def test_tables_by_their_header(tmp_path: Path, text: str) -> None:
    control = read_control(written(tmp_path, "gcp.csv", text), crs="EPSG:32633")
    assert control.points["P1"].given == (500010.5, 5400020.25) and control.points["P1"].height_m == 312.5
    assert [(m.image, m.x_px, m.y_px) for m in control.marks] == [("a.jpg", 10.0, 20.0), ("b.jpg", 11.0, 21.0)]


def test_longitude_latitude_accuracy_and_roles(tmp_path: Path) -> None:
    text = "label,longitude,latitude,altitude,accuracy h,accuracy v,type\nA,15.1,48.2,300,0.01,0.02,control\n"
    text += "B,15.2,48.3,,0.05,0.05,check\n"
    marks = written(tmp_path, "marks.csv", "image,label,px,py\na.jpg,A,1,2\n")
    control = read_control(written(tmp_path, "gcp.csv", text), marks=marks)
    a, b = control.points["A"], control.points["B"]
    assert (round(a.lon_deg, 9), round(a.lat_deg, 9), a.sigma_h_m, a.sigma_v_m) == (15.1, 48.2, 0.01, 0.02)
    assert b.checkpoint and b.height_m is None and not a.checkpoint
    assert control.marks[0].label == "A"


def test_geojson(tmp_path: Path) -> None:
    def feature(label: str, **more: object) -> dict[str, object]:
        geometry = {"type": "Point", "coordinates": [15.1, 48.2, 300.0]}
        return {"type": "Feature", "geometry": geometry, "properties": {"name": label, **more}}

    marks = [{"image": "a.jpg", "x": 1.0, "y": 2.0}]
    told = {"type": "FeatureCollection", "features": [feature("A", marks=marks), feature("B", checkpoint=True)]}
    control = read_control(written(tmp_path, "gcp.geojson", json.dumps(told)))
    assert control.points["B"].checkpoint and not control.points["A"].checkpoint
    assert control.points["A"].height_m == 300.0 and control.marks[0].image == "a.jpg"


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("gcp_list.txt", "", "no control"),
        ("gcp_list.txt", "nonsense\n1 2 3 4 5 a.jpg\n", "line 1.*CRS"),
        ("gcp_list.txt", "EPSG:32633\n500010 5400020 3 1 2\n", "line 2.*expected x y z px py image"),
        ("gcp_list.txt", "EPSG:32633\n500010 north 3 1 2 a.jpg\n", "line 2.*y must be a number"),
        ("gcp_list.txt", "EPSG:32633\n500010 5400020 3 inf 2 a.jpg\n", "line 2.*not finite"),
        ("gcp_list.txt", "EPSG:4326\n48.2 150.1 3 1 2 a.jpg\n", "line 2.*no place.*exchanged"),
        (
            "gcp_list.txt",
            "EPSG:32633\n500010 5400020 3 1 2 a.jpg P\n500011 5400020 3 1 2 b.jpg P\n",
            "line 3.*other coord",
        ),
        ("gcp.csv", "A,1,2,3\n", "line 1.*header"),
        ("gcp.csv", "label,x,y,z\nA,1,2,3\n", "does not say what its coordinates refer to"),
        ("gcp.csv", "# EPSG:32633\nlabel,colour\nA,red\n", "header must name"),
        ("gcp.csv", "# EPSG:32633\nlabel,x,y,z,sigma\nA,500000,5400000,3,-1\n", "line 3.*greater than 0"),
        ("gcp.csv", "# EPSG:32633\nlabel,x,y,z\n,500000,5400000,3\n", "line 3.*label is missing"),
        ("gcp.csv", "label,lon,lat,image,px,py\nA,15,48,,,\nB,,,a.jpg,1,2\n", "B is marked .* no coordinates"),
        ("gcp.geojson", "{", "no GeoJSON"),
        ("gcp.geojson", '{"features": [{"geometry": {"type": "Polygon", "coordinates": []}}]}', "is no point"),
        ("gcp.geojson", "[" * 100_000, "no GeoJSON"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, name: str, text: str, said: str) -> None:
    path = written(tmp_path, name, text)
    with pytest.raises(ReferenceFormatError, match=said) as caught:
        read_control(path)
    assert name in str(caught.value)


def test_random_bytes_never_show_a_traceback(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for k in range(60):
        name = ("gcp_list.txt", "gcp.csv", "gcp.geojson")[k % 3]
        path = tmp_path / name
        damaged = bytearray(GCP_LIST.encode())
        for place in rng.integers(0, len(damaged), 8):
            damaged[place] = int(rng.integers(0, 256))
        path.write_bytes(bytes(damaged))
        try:
            read_control(path)
        except ReferenceFormatError as error:
            assert name in str(error)


def test_checkpoints_by_label(tmp_path: Path) -> None:
    path = str(written(tmp_path, "gcp_list.txt", GCP_LIST))
    control = control_of(GeoreferenceOptions(control=path, checkpoints="P1"))
    assert control is not None and control.points["P1"].checkpoint
    with pytest.raises(ReferenceFormatError, match="no point 'P9'"):
        control_of(GeoreferenceOptions(control=path, checkpoints="P9"))
    assert control_of(GeoreferenceOptions()) is None
