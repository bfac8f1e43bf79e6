"""Plan the shards of a dataset before scenes are created. The shard is the unit of resumption and of parallel work."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pipelines.preprocess.sources import argoverse2, custom, kitti360, py123d
from pipelines.preprocess.sources.maps import list_map_files
from pipelines.preprocess.sources.opendrive import file
from pipelines.preprocess.sources.opendrive import reader as opendrive
from pipelines.preprocess.sources.osm import extract
from pipelines.preprocess.sources.osm import reader as osm
from pipelines.preprocess.sources.town import generator
from pipelines.schema.splits import ARGOVERSE2_SPLIT, TEST, TRAIN, UNUSED, make_no_split, split_poses, split_squares
from pipelines.schema.tables import Shard

SHARD_SCENES = 256
LOGS_PER_SHARD = 2  # Argoverse 2 has about 160 sweeps per log.

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class ShardPart:
    """A set of poses of one drive.

    Attributes:
        key: Arguments of the reader of the source (shard_writer.read_drive).
        sequence: Name of the drive.
        poses: Indices of the poses; None: all poses.
        frames: Frame number of each of these poses. If the drive is unreadable, each of these frames becomes a reject.
    """

    key: tuple
    sequence: str
    poses: tuple[int, ...] | None = None
    frames: tuple[int, ...] | None = None


@dataclass(frozen=True)
class ShardTask:
    """A shard to write: source, split, number and parts."""

    source: str
    split: str
    number: int
    parts: tuple[ShardPart, ...]

    def shard(self, root: str) -> Shard:
        """Return the shard in a dataset directory.

        Args:
            root: Dataset directory.

        Returns:
            The shard.
        """
        return Shard(root, self.source, self.split, self.number)


def plan_town(
    num_train: int, num_test: int, seed: int, version: int = generator.TOWN_VERSION, free_pose_share: float = 0.0
) -> list[ShardTask]:
    """Plan one task per town.

    Args:
        num_train: Number of training scenes.
        num_test: Number of test scenes.
        seed: Seed that selects the towns.
        version: Version of the town.
        free_pose_share: Share of the scenes of each split that are crops at any place and heading.

    Returns:
        The tasks.
    """
    parts = generator.plan_town_parts(num_train, num_test, seed)
    plan: list[tuple[str, tuple[ShardPart, ...]]] = []
    done: dict[str, int] = dict.fromkeys((TRAIN, TEST), 0)
    for town_seed, split, count in parts:
        # Rounding the cumulative number makes the share exact in each split.
        num_free = round((done[split] + count) * free_pose_share) - round(done[split] * free_pose_share)
        done[split] += count
        plan.append((split, (ShardPart((town_seed, count, version, num_free), f"{town_seed:05d}"),)))
    return _number_tasks("town", plan)


def plan_kitti360(root: str, split: bool = True, skip_unreadable: bool = False) -> list[ShardTask]:
    """Plan tasks of at most SHARD_SCENES poses of one sequence and one split.

    Args:
        root: Directory of KITTI-360.
        split: Whether to use the paper's split. If False, all poses get the split train.
        skip_unreadable: Whether a sequence with missing or invalid poses becomes a reject. If False, such a sequence
            raises an error.

    Returns:
        The tasks.

    Raises:
        ValueError: Poses are missing or invalid, and skip_unreadable is False.
    """
    poses, unreadable = _read_poses(
        kitti360.list_sequences(root), lambda name: kitti360.read_poses(root, name), skip_unreadable
    )
    labels = (split_poses if split else make_no_split)({name: matrix[:, :, 3] for name, (_, matrix) in poses.items()})
    keys = {name: (root, name) for name in [*poses, *unreadable]}
    return _plan_drives("kitti360", keys, {name: frame for name, (frame, _) in poses.items()}, labels)


def plan_custom(root: str, split: bool = True, skip_unreadable: bool = False) -> list[ShardTask]:
    """Plan tasks for a user's own drives.

    A task has at most SHARD_SCENES poses of one drive and one split.

    Args:
        root: Directory of all drives.
        split: Whether to use the paper's split if splits.json is absent. If False, all poses get the split train.
        skip_unreadable: Whether a drive with missing or invalid poses becomes a reject. If False, such a drive raises
            an error.

    Returns:
        The tasks.

    Raises:
        ValueError: Poses are missing or invalid, and skip_unreadable is False; or no drive has ground.
    """
    poses, unreadable = _read_poses(
        custom.list_drives(root), lambda name: custom.read_poses(root, name), skip_unreadable
    )
    given = custom.read_splits(root)
    if given is not None:
        labels = {name: np.full(len(frame), given[name], object) for name, (frame, _) in poses.items()}
    else:
        labels = (split_poses if split else make_no_split)(
            {name: matrix[:, :, 3] for name, (_, matrix) in poses.items()}
        )
    classes = custom.read_ground_classes(root)
    keys = {name: (root, name, classes) for name in [*poses, *unreadable]}
    return _plan_drives("own", keys, {name: frame for name, (frame, _) in poses.items()}, labels)


def plan_osm(inputs: tuple[str, ...], options: osm.OsmOptions, test_share: float) -> list[ShardTask]:
    """Plan tasks of at most SHARD_SCENES poses of one extract of OpenStreetMap and one split.

    Args:
        inputs: Extracts, or directories of extracts.
        options: Options of the reader.
        test_share: Maximum share of the poses that get the split test.

    Returns:
        The tasks.

    Raises:
        ValueError: A file cannot be read, no street lies in the region, or no training scene remains.
    """
    keys, frames, labels = {}, {}, {}
    for path in list_map_files(inputs, extract.SUFFIXES, extract.GET_EXTRACT):
        name, poses = osm.read_poses(path, options)
        keys[name], frames[name] = (path, options), np.arange(len(poses.xy_m))
        labels[name] = split_squares(poses.xy_m, poses.yaw_rad, test_share)
    _require_training_scenes(labels, test_share)
    return _plan_drives(osm.SOURCE, keys, frames, labels)


def _require_training_scenes(labels: dict[str, np.ndarray], test_share: float) -> None:
    if not any((split == TRAIN).any() for split in labels.values()):
        raise ValueError(
            f"--test-share {test_share:g} leaves no training scene, because crops near test squares are not used; "
            "specify a smaller share, or 0 for a place of less than 1 km"
        )


def plan_opendrive(inputs: tuple[str, ...], options: opendrive.OpenDriveOptions, test_share: float) -> list[ShardTask]:
    """Plan tasks of at most SHARD_SCENES poses of one OpenDRIVE file and one split.

    Args:
        inputs: OpenDRIVE files, or directories of such files.
        options: Options of the reader.
        test_share: Maximum share of the poses that get the split test.

    Returns:
        The tasks.

    Raises:
        ValueError: A file cannot be read, it has no driving lane, or no training scene remains.
    """
    keys, frames, labels = {}, {}, {}
    for path in list_map_files(inputs, file.SUFFIXES, file.GET_FILE):
        name, poses = opendrive.read_poses(path, options)
        keys[name], frames[name] = (path, options), np.arange(len(poses.yaw_rad))
        labels[name] = split_squares(poses.xyz_m[:, :2], poses.yaw_rad, test_share)
    _require_training_scenes(labels, test_share)
    return _plan_drives(opendrive.SOURCE, keys, frames, labels)


def plan_argoverse2(root: str) -> list[ShardTask]:
    """Plan tasks of LOGS_PER_SHARD logs each.

    Logs of the split `train` keep this split, and logs of the split `val` get the split `test`.

    Args:
        root: Directory of the sensor dataset.

    Returns:
        The tasks.
    """
    plan = []
    for theirs, side in ARGOVERSE2_SPLIT.items():
        logs = [log for split, log in argoverse2.list_logs(root) if split == theirs]
        for start in range(0, len(logs), LOGS_PER_SHARD):
            plan.append(
                (side, tuple(ShardPart((root, theirs, log), log) for log in logs[start : start + LOGS_PER_SHARD]))
            )
    return _number_tasks("av2", plan)


def plan_py123d(root: str) -> list[ShardTask]:
    """Plan tasks of LOGS_PER_SHARD logs each.

    Logs of splits that end with "train" get the split train, and the others the split test. If there are only others,
    they get the split train.

    Args:
        root: Directory into which py123d-conversion wrote.

    Returns:
        The tasks.

    Raises:
        ValueError: The directory holds no log, or two logs have the same name.
    """
    logs = py123d.list_logs(root)
    if twice := [name for name, count in Counter(log for _, log in logs).items() if count > 1]:
        raise ValueError(f"{root}: two splits hold a log {twice[0]}; move one of them out of logs/")
    trains = {split for split, _ in logs if split.endswith(TRAIN)} or {split for split, _ in logs}
    plan = []
    for side in (TRAIN, TEST):
        chosen = [one for one in logs if (one.split in trains) == (side == TRAIN)]
        for start in range(0, len(chosen), LOGS_PER_SHARD):
            parts = (ShardPart((root, *one), one.log) for one in chosen[start : start + LOGS_PER_SHARD])
            plan.append((side, tuple(parts)))
    return _number_tasks(py123d.SOURCE, plan)


Poses = tuple[np.ndarray, np.ndarray]  # frame (p,) and world_from_imu (p, 3, 4)


def _read_poses(
    names: list[str], read: Callable[[str], Poses], skip_unreadable: bool
) -> tuple[dict[str, Poses], list[str]]:
    """Return the poses of all readable drives, and the names of the unreadable drives."""
    poses, unreadable = {}, []
    for name in names:
        try:
            poses[name] = read(name)
        except ValueError as error:
            if not skip_unreadable:
                raise ValueError(f"{error}. Or add --skip-unreadable to skip this drive") from error
            logger.warning("skipped a drive: %s", error)
            unreadable.append(name)
    return poses, unreadable


def _plan_drives(
    source: str, keys: dict[str, tuple], frames: dict[str, np.ndarray], labels: dict[str, np.ndarray]
) -> list[ShardTask]:
    """Plan the tasks drive by drive.

    Consecutive tasks can then share a drive in memory. A drive without frames is unreadable. The task of an unreadable
    drive writes one reject.
    """
    plan = [(UNUSED, (ShardPart(key, name),)) for name, key in keys.items() if name not in frames]
    for name, frame in frames.items():
        for side in (TRAIN, TEST, UNUSED):
            members = np.flatnonzero(labels[name] == side)
            for start in range(0, len(members), SHARD_SCENES):
                poses = members[start : start + SHARD_SCENES]
                part = ShardPart(keys[name], name, tuple(poses.tolist()), tuple(frame[poses].tolist()))
                plan.append((side, (part,)))
    return _number_tasks(source, plan)


def _number_tasks(source: str, plan: list[tuple[str, tuple[ShardPart, ...]]]) -> list[ShardTask]:
    """Make tasks from pairs (split, parts). Shards are numbered within each split."""
    tasks: list[ShardTask] = []
    numbers: dict[str, int] = dict.fromkeys((TRAIN, TEST, UNUSED), 0)
    for split, parts in plan:
        tasks.append(ShardTask(source, split, numbers[split], parts))
        numbers[split] += 1
    return tasks
