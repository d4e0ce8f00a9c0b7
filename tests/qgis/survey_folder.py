"""A run's output folder made by hand: every file that QGIS loads, over the same hundred metres."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

CRS = "EPSG:32633"
WEST, SOUTH, SIDE_M = 500_000.0, 5_000_000.0, 100.0
BRICK = (180, 60, 30)  # the colour of the cloud and of the orthophoto, 8 bits


def make_run(folder: Path, photos: Path, geopackage: bool = True) -> Path:
    """Write report, record, tables, rasters; `photos` gets two pictures."""
    (folder / "work").mkdir(parents=True)
    photos.mkdir(parents=True, exist_ok=True)
    _pictures(photos)
    (folder / "work" / "run.json").write_text(
        json.dumps({"format": 2, "error": '"photos": "x"', "photos": str(photos)})
    )
    report: dict[str, Any] = {
        "images": {"given": 3, "placed": 2, "rejected": [{"image": "c.jpg", "stage": "queries", "reason": "blurred"}]},
        "georeference": {"crs": CRS, "rmse_h_m": 0.1, "rmse_v_m": 0.2},
        "cloud": {"path": "cloud.laz", "points": 4, "mean_spacing_m": 1.0},
        "warnings": ["a first warning", "a first warning", "a second one"],
    }
    (folder / "report.json").write_text(json.dumps(report), encoding="utf-8")
    (folder / "report.html").write_text("<html></html>")
    (folder / "cloud.laz").write_bytes(b"LASF")
    _tables(folder, geopackage)
    for name, bands in (("orthophoto", 3), ("dsm", 1), ("dtm", 1)):
        _raster(folder / f"{name}.tif", bands)
    return folder


def _pictures(photos: Path) -> None:
    from qgis.PyQt.QtGui import QColor, QImage

    for name in ("a.jpg", "b.jpg"):
        picture = QImage(64, 48, QImage.Format.Format_RGB32)
        picture.fill(QColor(*BRICK))
        picture.save(str(photos / name))


def _tables(folder: Path, geopackage: bool) -> None:
    from qgis.core import QgsCoordinateTransformContext, QgsFeature, QgsGeometry, QgsVectorFileWriter, QgsVectorLayer

    text = "&field=".join(("image:string", "status:string", "stage:string", "reason:string"))
    points = f"Point?crs={CRS}&field={text}&field=number:integer&field=d_3d:double&field=d_h:double&field=dz:double"
    ground = f"Polygon?crs={CRS}&field=image:string&field=number:integer&field=gsd_m:double&field=overlap:integer"
    placed = [("a.jpg", "placed", "", "", 1, 0.1, 0.1, 0.0), ("b.jpg", "placed", "", "", 2, 1.0, 0.8, 0.6)]
    refused = [("c.jpg", "rejected", "queries", "blurred", 3, None, None, None)]
    square = (
        f"POLYGON(({WEST} {SOUTH}, {WEST + 50} {SOUTH}, {WEST + 50} {SOUTH + 50}, {WEST} {SOUTH + 50}, {WEST} {SOUTH}))"
    )
    at = [f"POINT({WEST + x} {SOUTH + 30})" for x in (20, 60, 80)]
    if geopackage:
        tables = {
            "cameras": (points, placed, at),
            "rejected": (points, refused, at[2:]),
            "control": (points, placed, at),
        }
    else:
        tables = {"cameras": (points, placed + refused, at)}
    tables["footprints"] = (ground, [("a.jpg", 1, 0.02, 5)], [square])
    if not geopackage:  # their cameras do not tell the stage
        uri, rows, places = tables["cameras"]
        tables["cameras"] = (uri.replace("&field=stage:string", ""), [(*row[:2], *row[3:]) for row in rows], places)
    for name, (uri, rows, places) in tables.items():
        layer = QgsVectorLayer(uri, name, "memory")
        for row, place in zip(rows, places, strict=False):
            feature = QgsFeature(layer.fields())
            feature.setAttributes(list(row))
            feature.setGeometry(QgsGeometry.fromWkt(place))
            assert layer.dataProvider().addFeature(feature)
        options = QgsVectorFileWriter.SaveVectorOptions()
        path = folder / ("survey.gpkg" if geopackage else f"{name}.shp")
        options.driverName, options.layerName = ("GPKG", name) if geopackage else ("ESRI Shapefile", "")
        if path.is_file():
            options.actionOnExistingFile = QgsVectorFileWriter.ActionOnExistingFile.CreateOrOverwriteLayer
        written = QgsVectorFileWriter.writeAsVectorFormatV3(layer, str(path), QgsCoordinateTransformContext(), options)
        assert written[0] == QgsVectorFileWriter.WriterError.NoError, written


def _raster(path: Path, bands: int) -> None:
    from osgeo import gdal, osr

    size = 50
    made = gdal.GetDriverByName("GTiff").Create(
        str(path), size, size, bands, gdal.GDT_Byte if bands > 1 else gdal.GDT_Float32
    )
    made.SetGeoTransform((WEST, SIDE_M / size, 0.0, SOUTH + SIDE_M, 0.0, -SIDE_M / size))
    reference = osr.SpatialReference()
    reference.ImportFromEPSG(32633)
    made.SetProjection(reference.ExportToWkt())
    for band in range(bands):
        values = bytes([BRICK[band]]) * size**2 if bands > 1 else struct.pack(f"<{size**2}f", *range(size**2))
        kind = gdal.GDT_Byte if bands > 1 else gdal.GDT_Float32
        made.GetRasterBand(band + 1).WriteRaster(0, 0, size, size, values, buf_type=kind)
    made.FlushCache()
    del made


def make_ept(folder: Path, colour: tuple[int, int, int], side: int = 40) -> Path:
    """Write a point cloud that every QGIS reads, uncompressed, with colours in 16 bits; return its ept.json."""
    scale, names = 0.01, ("X", "Y", "Z", "Red", "Green", "Blue")
    for part in ("ept-data", "ept-hierarchy"):
        (folder / part).mkdir(parents=True)
    points = [(x * SIDE_M / side, y * SIDE_M / side, 10.0) for x in range(side) for y in range(side)]
    deep = [257 * value for value in colour]
    data = b"".join(struct.pack("<3i3H", *(round(value / scale) for value in point), *deep) for point in points)
    (folder / "ept-data" / "0-0-0-0.bin").write_bytes(data)
    (folder / "ept-hierarchy" / "0-0-0-0.json").write_text(json.dumps({"0-0-0-0": len(points)}))
    schema = [
        {"name": name, "type": "signed", "size": 4, "scale": scale, "offset": offset}
        for name, offset in zip(names[:3], (WEST, SOUTH, 0.0), strict=True)
    ]
    schema += [{"name": name, "type": "unsigned", "size": 2} for name in names[3:]]
    cube = [WEST, SOUTH, 0.0, WEST + SIDE_M, SOUTH + SIDE_M, SIDE_M]
    told = {
        "bounds": cube, "boundsConforming": [*cube[:5], 20.0], "dataType": "binary", "hierarchyType": "json",
        "points": len(points), "span": 128, "version": "1.0.0", "schema": schema,
        "srs": {"authority": "EPSG", "horizontal": "32633", "wkt": _wkt()},
    }  # fmt: skip
    (folder / "ept.json").write_text(json.dumps(told))
    return folder / "ept.json"


def _wkt() -> str:
    from osgeo import osr

    reference = osr.SpatialReference()
    reference.ImportFromEPSG(32633)
    return str(reference.ExportToWkt())
