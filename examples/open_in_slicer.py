"""Opens in 3D Slicer what ``mvest export slicer`` wrote.

In Slicer's Python console: ``FOLDER = r"..."``, then paste this file; or from a shell
``Slicer --python-script open_in_slicer.py FOLDER``. Surfaces over time become sequences, which the
toolbar of the module Sequences plays, coloured by the first of `COLOURS` that they carry.
"""

import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import slicer

COLOURS = ("distance_mm", "stretch_of_area")


def load_series(index):
    """One sequence of models for an index ``.pvd``, and a browser that shows it."""
    scene = slicer.mrmlScene
    sequence = scene.AddNewNodeByClass("vtkMRMLSequenceNode", index.stem)
    sequence.SetIndexName("time")
    sequence.SetIndexUnit("s")
    for entry in ET.parse(index).findall("Collection/DataSet"):
        state = slicer.util.loadModel(str(index.parent / entry.get("file")))
        sequence.SetDataNodeAtValue(state, entry.get("timestep"))
        scene.RemoveNode(state)
    browser = scene.AddNewNodeByClass("vtkMRMLSequenceBrowserNode", f"{index.stem} over time")
    browser.SetAndObserveMasterSequenceNodeID(sequence.GetID())
    slicer.modules.sequences.logic().UpdateAllProxyNodes()
    model = browser.GetProxyNode(sequence)
    model.CreateDefaultDisplayNodes()
    arrays = model.GetPolyData().GetPointData()
    for name in COLOURS:
        if arrays.HasArray(name):
            display = model.GetDisplayNode()
            display.SetActiveScalarName(name)
            display.SetAndObserveColorNodeID("vtkMRMLColorTableNodeFileViridis.txt")
            display.SetScalarVisibility(True)
            break
    return browser


def load_folder(folder):
    """Load all series and landmarks."""
    for index in sorted(folder.glob("*.pvd")):
        load_series(index)
    for file in sorted(folder.glob("*.mrk.json")):
        slicer.util.loadMarkups(str(file))
    slicer.util.resetThreeDViews()


load_folder(Path(globals().get("FOLDER") or sys.argv[-1]))
