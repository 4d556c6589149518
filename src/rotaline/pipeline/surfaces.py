"""Surfaces of the scanned parts, as stored stages."""

import numpy as np

from rotaline.errors import GeometryError
from rotaline.io.report.contents import SurfaceSummary
from rotaline.pipeline.options import Options
from rotaline.pipeline.scan import Clouds
from rotaline.pipeline.store import StageStore, key_of
from rotaline.scanning.surface import reconstruct_surface


def stored_surface(
    folder: str, clouds: Clouds, table_seen: bool, options: Options, store: StageStore
) -> SurfaceSummary:
    """The surface of the part in a scan, without the table unless it is to be kept; it says why where there is none."""

    def compute() -> SurfaceSummary:
        cloud = clouds[folder]
        if table_seen and not options.scan.keep_table:
            cloud = cloud.select(cloud.points_table[:, 2] > options.scan.table_margin_mm)
        try:
            surface = reconstruct_surface(cloud, options.surface)
        except GeometryError as error:
            return SurfaceSummary(folder, np.empty((0, 3)), np.empty((0, 3), dtype=int), str(error))
        return SurfaceSummary(folder, surface.vertices_table, surface.triangles)

    key = key_of(clouds.scanned[folder].key, options.surface, options.scan, table_seen)
    return store.get(f"surface-{folder}", f"Surface of {folder}", key, compute)
