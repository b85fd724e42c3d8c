"""Small rasters in the formats of planetary data, and text by which GDAL reads other files."""

import math

import numpy as np
import rasterio

SECRET = 77777.0
"""Value of the file to which hostile rasters refer."""


def tiff(folder, values, crs=None, **options):
    """GeoTIFF."""
    path = folder / "ground.tif"
    rows, columns = values.shape
    with rasterio.open(
        path, "w", driver="GTiff", width=columns, height=rows, count=1, dtype=values.dtype.name, crs=crs, **options
    ) as file:
        file.write(values, 1)
    return path


def raw_vrt(folder, rows, columns):
    """Text of a VRT that reads a file as raw float32."""
    np.full((rows, columns), SECRET, "<f4").tofile(folder / "secret.bin")
    band = (
        f'<SourceFilename relativeToVRT="0">{folder}/secret.bin</SourceFilename><ImageOffset>0</ImageOffset>'
        f"<PixelOffset>4</PixelOffset><LineOffset>{4 * columns}</LineOffset>"
    )
    return (
        f'<VRTDataset rasterXSize="{columns}" rasterYSize="{rows}">'
        f'<VRTRasterBand dataType="Float32" band="1" subClass="VRTRawRasterBand">{band}</VRTRasterBand></VRTDataset>'
    )


def pds3(folder, values, data="ground.IMG", resolution=6064.0, corner_deg=(-20.0, 340.0), image=()):
    """PDS3 label, with float32 data behind it: simple cylindrical about longitude 180, pixels per degree."""
    rows, columns = values.shape
    sample, line = (180 - corner_deg[1]) * resolution - 0.5, corner_deg[0] * resolution - 0.5
    text = [
        'PDS_VERSION_ID = "PDS3"',
        "RECORD_TYPE = FIXED_LENGTH",
        f"RECORD_BYTES = {4 * columns}",
        f"FILE_RECORDS = {rows}",
        "TARGET_NAME = MOON",
        f'^IMAGE = "{data}"',
        "OBJECT = IMAGE",
        f"LINES = {rows}",
        f"LINE_SAMPLES = {columns}",
        "SAMPLE_TYPE = PC_REAL",
        "SAMPLE_BITS = 32",
        *image,
        "END_OBJECT = IMAGE",
        "OBJECT = IMAGE_MAP_PROJECTION",
        'MAP_PROJECTION_TYPE = "SIMPLE CYLINDRICAL"',
        f"MAP_RESOLUTION = {resolution!r} <pix/deg>",
        *(f"{axis}_AXIS_RADIUS = 1737.4 <km>" for axis in "ABC"),
        'POSITIVE_LONGITUDE_DIRECTION = "EAST"',
        "CENTER_LATITUDE = 0 <deg>",
        "CENTER_LONGITUDE = 180 <deg>",
        f"MAP_SCALE = {2 * math.pi * 1737.4 / 360 / resolution!r} <km/pix>",
        f"LINE_PROJECTION_OFFSET = {line!r} <pix>",
        f"SAMPLE_PROJECTION_OFFSET = {sample!r} <pix>",
        "END_OBJECT = IMAGE_MAP_PROJECTION",
        "END",
        "",
    ]
    path = folder / "ground.LBL"
    path.write_bytes("\r\n".join(text).encode())
    values.astype("<f4").tofile(folder / "ground.IMG")
    return path


def pds4(folder, values, data="ground.img", element=""):
    """PDS4 label, with float32 data behind it, without a map."""
    rows, columns = values.shape
    axes = "".join(
        f"<Axis_Array><axis_name>{name}</axis_name><elements>{n}</elements><sequence_number>{k}</sequence_number>"
        "</Axis_Array>"
        for k, (name, n) in enumerate((("Line", rows), ("Sample", columns)), 1)
    )
    path = folder / "ground.xml"
    path.write_text(
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        '<Product_Observational xmlns="http://pds.nasa.gov/pds4/pds/v1"><File_Area_Observational>'
        f"<File><file_name>{data}</file_name></File>"
        '<Array_2D_Image><offset unit="byte">0</offset><axes>2</axes>'
        "<axis_index_order>Last Index Fastest</axis_index_order>"
        f"<Element_Array><data_type>IEEE754LSBSingle</data_type>{element}</Element_Array>{axes}"
        "</Array_2D_Image></File_Area_Observational></Product_Observational>\n"
    )
    values.astype("<f4").tofile(folder / "ground.img")
    return path


def isis_cube(folder, values, mapping=""):
    """ISIS cube with its label inside; `mapping` is the text of the group Mapping."""
    path = folder / "ground.cub"
    label = _isis_label(values, "StartByte = 65537", mapping)
    path.write_bytes(label.encode().ljust(65536, b"\0") + values.astype("<f4").tobytes())
    return path


def isis_detached(folder, values, data="ground.dat", mapping=""):
    """ISIS label, with its data in another file."""
    path = folder / "ground.lbl"
    path.write_text(_isis_label(values, f"^Core = {data}\n    StartByte = 1", mapping))
    values.astype("<f4").tofile(folder / "ground.dat")
    return path


def _isis_label(values, place, mapping):
    rows, columns = values.shape
    return (
        f"Object = IsisCube\n  Object = Core\n    {place}\n    Format = BandSequential\n"
        f"    Group = Dimensions\n      Samples = {columns}\n      Lines = {rows}\n      Bands = 1\n    End_Group\n"
        "    Group = Pixels\n      Type = Real\n      ByteOrder = Lsb\n      Base = 0.0\n      Multiplier = 1.0\n"
        f"    End_Group\n  End_Object\n{mapping}End_Object\nEnd\n"
    )
