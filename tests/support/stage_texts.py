"""Valid stages as text, and texts that make others."""

STAGE = """#usda 1.0
(
    defaultPrim = "Cloth"
    metersPerUnit = 1
    kilogramsPerUnit = 1
    upAxis = "Y"
    timeCodesPerSecond = 24
    framesPerSecond = 24
    startTimeCode = 0
    endTimeCode = 3
    customLayerData = {
        dictionary warpcloth = {
            string prim = "/Cloth"
        }
    }
)

def Mesh "Cloth"
{
    int[] faceVertexCounts = [3, 3]
    int[] faceVertexIndices = [0, 2, 1, 1, 2, 3]
    point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 0, 1), (1, 0, 1)]
    point3f[] points.timeSamples = {
        0: [(0, 0, 0), (1, 0, 0), (0, 0, 1), (1, 0, 1)],
        3: [(0, 0.1, 0), (1, 0.1, 0), (0, 0, 1), (1, 0, 1)],
    }
    uniform token orientation = "leftHanded"
    texCoord2f[] primvars:st = [(0, 0), (1, 0), (0, 1), (1, 1)] (
        interpolation = "vertex"
    )
    double warpcloth:density = 0.15
    double warpcloth:duration = 0.125
    double3 warpcloth:gravity = (0, -9.81, 0)
    double3[] warpcloth:pins:keyframes.timeSamples = {0: [(0, 0, 0), (1, 0, 0)], 1: [(0, 0, 0), (1, 0, 0)]}
    token warpcloth:terms:threads:type = "Spring"
    token warpcloth:terms:threads:pairs = "edges"
    double warpcloth:terms:threads:stiffness = 1000

    def GeomSubset "pins"
    {
        uniform token elementType = "point"
        uniform token familyName = "pins"
        int[] indices = [0, 1]
    }
}
"""


MOVED = "".join(line for line in STAGE.splitlines(keepends=True) if "keyframes" not in line)  # pins follow the points
CURVES = """#usda 1.0
(
    metersPerUnit = 1
)

def BasisCurves "Cloth"
{
    int[] curveVertexCounts = [5]
    point3f[] points = [(0, -0, 0), (0, -0.25, 0), (0, -0.5, 0), (0, -0.75, 0), (0, -1, 0)]
    int[] primvars:warpcloth:vertex = [0, 1, 2, 3, 4]
    uniform token type = "linear"
    double warpcloth:density = 0.1
    double warpcloth:duration = 1
    token warpcloth:terms:Spring:type = "Spring"
    double warpcloth:terms:Spring:stiffness = 100
    float[] widths = [0.0125]
    uniform token wrap = "nonperiodic"

    def GeomSubset "pins"
    {
        uniform token elementType = "point"
        uniform token familyName = "pins"
        int[] indices = [0]
    }
}
"""


def prim(kind, name, *texts, meta=""):
    """A prim of which each text is on a line of its own."""
    return f'def {kind} "{name}" {meta}\n{{\n' + "\n".join(texts) + "\n}\n"
