"""Convert logs of Argoverse 2 without sensor data to the Arrow files of py123d, with the code of py123d 0.7.

    .venv-py123d/bin/python tests/data/py123d/convert_av2.py AV2/train OUTPUT

py123d-conversion needs the calibration and the point clouds of a log; the excerpt for tests has neither.
"""

import sys
from pathlib import Path

from py123d.api.map.arrow.arrow_map_writer import ArrowMapWriter
from py123d.api.scene.arrow.arrow_log_writer import ArrowLogWriter, SyncConfig
from py123d.api.scene.arrow.utils.log_writer_config import LogWriterConfig
from py123d.parser.av2.av2_map_parser import Av2MapParser
from py123d.parser.av2.av2_sensor_parser import (
    AV2_SENSOR_BOX_DETECTIONS_SE3_METADATA,
    AV2_SENSOR_EGO_STATE_SE3_METADATA,
    Av2SensorLogParser,
)

source, output = Path(sys.argv[1]), Path(sys.argv[2])
split = f"av2-sensor_{source.name}"
config = LogWriterConfig(force_log_conversion=True, force_map_conversion=True, async_conversion=True)
sync = SyncConfig(reference_column="box_detections_se3.timestamp_us", direction="forward")
for log in sorted(source.iterdir()):
    reader = Av2MapParser(source_log_path=log, split=split, dataset="av2-sensor")
    writer = ArrowMapWriter(force_map_conversion=True, maps_root=output / "maps", logs_root=output / "logs")
    writer.reset(reader.get_map_metadata())
    for item in reader.iter_map_objects():
        writer.write_map_object(item)
    writer.close()
    parser = Av2SensorLogParser(log, split, "nearest")
    logs = ArrowLogWriter(config, output / "logs", output / "sensors", sync_config=sync)
    logs.reset(parser.get_log_metadata())
    for state in parser._iter_ego_states_se3(AV2_SENSOR_EGO_STATE_SE3_METADATA):
        logs.write_async(state)
    for boxes in parser._iter_box_detections_se3(AV2_SENSOR_BOX_DETECTIONS_SE3_METADATA):
        logs.write_async(boxes)
    logs.close()
