"""The command ``scenes``: lists scenes and their parameters."""

from ..run.listing import folders, list_scenes


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
