"""The command ``scenes``: lists scenes and their parameters."""

from ..run.listing import folders, list_scenes

TEXT = "List scenes and their parameters."


def add_arguments(parser):
    """Adds the arguments of this command."""
    text = "a folder of scene files (default: ./scenes and the included scenes)"
    parser.add_argument("folder", metavar="FOLDER", nargs="?", help=text)


def scenes(arguments):
    found = [arguments.folder] if arguments.folder else folders()
    for folder, scenes in [(folder, list_scenes(folder)) for folder in found]:
        print(f"{folder}:")
        for listed in scenes:
            details = [listed.summary, ", ".join(listed.parameters), listed.meaning]
            print(f"  {listed.name}")
            print("".join(f"      {detail}\n" for detail in details if detail), end="")
    if not found:
        print("no folder ./scenes, and none that came with the package; give a folder")
    return 0
