"""The command ``sb3-offline render``."""

import argparse

from sb3_offline.data_tools.converting.render_dataset import render_dataset


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """:param parser: parser of the command"""
    parser.add_argument("dataset", help="dataset file with the extra scene_state, of states or of frames")
    parser.add_argument("output", help="HDF5 file to write; one that an interrupted run left is continued")
    parser.add_argument(
        "--obs-type",
        choices=("pixels", "both"),
        default="pixels",
        help="pixels: images alone (default); both: images and the state of the hand",
    )
    parser.add_argument("--size", type=int, default=64, help="width and height of a frame in pixels (default: 64)")
    parser.add_argument("--azimuth", type=float, help="azimuth of the camera, in degrees")
    parser.add_argument("--elevation", type=float, help="elevation of the camera, in degrees; negative looks down")
    parser.add_argument("--distance", type=float, help="distance of the camera from the point that it looks at, in metres")
    parser.add_argument("--lookat", type=float, nargs=3, metavar=("X", "Y", "Z"), help="that point, in metres")
    parser.add_argument(
        "--workers", type=int, default=2, help="number of processes, which does not change the file (default: 2)"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace another file")


def run(args: argparse.Namespace) -> None:
    """:param args: values of the options"""
    options = {name: getattr(args, name) for name in ("azimuth", "elevation", "distance", "lookat")}
    n_drawn = render_dataset(
        args.dataset,
        args.output,
        obs_type=args.obs_type,
        frame_size=args.size,
        camera={name: value for name, value in options.items() if value is not None},
        n_workers=args.workers,
        overwrite=args.overwrite,
    )
    print(f"{n_drawn:,} episodes drawn -> {args.output}" if n_drawn else f"{args.output} is complete already")
