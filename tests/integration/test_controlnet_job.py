"""Tests of jobs/paint_streets.py, whose Ray actors generate street photos of a drive."""

import pytest
from helpers import street_class_ids
from PIL import Image


def test_paint_job_paints_drive_and_resumes(controlnet_weights, tmp_path, cluster):
    from jobs.implementation.paint_streets import paint
    from jobs.paint_streets import Config

    drive = tmp_path / "streets" / "drive" / "scene-1"
    (drive / "class_id").mkdir(parents=True)
    for k in range(2):
        Image.fromarray(street_class_ids(24, 32)).save(drive / "class_id" / f"{k:06d}.png")
    options = {
        "streets": str(tmp_path / "streets" / "drive"),
        "diffusion": controlnet_weights[0],
        "controlnet": controlnet_weights[1],
        "num_inference_steps": 1,
    }
    assert paint(Config(**options)) == (options["streets"], 2)
    files = {path.name: path.stat().st_mtime_ns for path in (drive / "photo").iterdir()}
    assert set(files) == {"000000.png", "000001.png"} and (drive / "photos.webp").stat().st_size > 0
    (drive / "photo" / "000001.png").unlink()
    assert paint(Config(**options))[1] == 2
    again = {path.name: path.stat().st_mtime_ns for path in (drive / "photo").iterdir()}
    assert again["000000.png"] == files["000000.png"] and again["000001.png"] != files["000001.png"]
    with pytest.raises(
        ValueError, match=r'holds photographs with prompt="a photograph.*asked for "night"; delete its photo/'
    ):
        paint(Config(**options, prompt="night"))
