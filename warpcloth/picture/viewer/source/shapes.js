// Shapes in the scene: surfaces of triangles, tubes and balls, whose positions change from frame to frame.
import {
  BufferAttribute,
  BufferGeometry,
  Color,
  CylinderGeometry,
  DoubleSide,
  DynamicDrawUsage,
  Group,
  InstancedMesh,
  Matrix4,
  Mesh,
  MeshLambertMaterial,
  Quaternion,
  SphereGeometry,
  Vector3,
} from "three";

const NOWHERE = 65535;
// Edges that bend by more than 70° stay sharp. Where all triangles are within half of it from their mean, none does.
const SHARP = Math.cos((70 * Math.PI) / 180);
const SMOOTH = Math.cos((35 * Math.PI) / 180);

/** A material that is lit on both sides, with other colours on the back: factors of those on the front. */
function material(colour, back, coloured = false) {
  const found = new MeshLambertMaterial({ color: new Color().setRGB(...colour), side: DoubleSide, vertexColors: coloured });
  found.onBeforeCompile = (shader) => {
    shader.uniforms.back = { value: new Vector3(...back) };
    shader.fragmentShader = "uniform vec3 back;\n" + shader.fragmentShader.replace(
      "#include <color_fragment>",
      "#include <color_fragment>\nif (!gl_FrontFacing) diffuseColor.rgb *= back;",
    );
  };
  return found;
}

/** Triangles, each with corners of its own, so that it may have a colour of its own and sharp edges. */
class Surface {
  constructor(triangles, count, colour, back) {
    this.triangles = triangles;
    const corners = triangles.length;
    this.faces = new Float32Array(corners); // normals of length 1
    this.areas = new Float32Array(corners); // normals of twice the area
    this.normals = new Float32Array(3 * count);
    this.smooth = new Uint8Array(count);
    // The triangles of each vertex.
    this.first = new Uint32Array(count + 1);
    for (const vertex of triangles) this.first[vertex + 1]++;
    for (let i = 0; i < count; i++) this.first[i + 1] += this.first[i];
    const next = this.first.slice();
    this.around = new Uint32Array(corners);
    for (let k = 0; k < corners; k++) this.around[next[triangles[k]]++] = (k / 3) | 0;
    this.geometry = new BufferGeometry();
    for (const name of ["position", "normal", "color"]) {
      this.geometry.setAttribute(name, new BufferAttribute(new Float32Array(3 * corners), 3).setUsage(DynamicDrawUsage));
    }
    this.plain = material(colour, back);
    this.coloured = material([1, 1, 1], [1, 1, 1], true);
    this.object = new Mesh(this.geometry, this.plain);
    this.object.castShadow = this.object.receiveShadow = true;
    this.object.frustumCulled = false;
  }

  move(x) {
    const { triangles, faces, areas, normals, smooth, first, around } = this;
    const position = this.geometry.attributes.position.array;
    const normal = this.geometry.attributes.normal.array;
    normals.fill(0);
    for (let k = 0; k < triangles.length; k += 3) {
      const a = 3 * triangles[k], b = 3 * triangles[k + 1], c = 3 * triangles[k + 2];
      const ux = x[b] - x[a], uy = x[b + 1] - x[a + 1], uz = x[b + 2] - x[a + 2];
      const vx = x[c] - x[a], vy = x[c + 1] - x[a + 1], vz = x[c + 2] - x[a + 2];
      let nx = uy * vz - uz * vy, ny = uz * vx - ux * vz, nz = ux * vy - uy * vx;
      const known = nx - nx + (ny - ny) + (nz - nz) === 0;
      if (!known) nx = ny = nz = 0;
      const length = Math.sqrt(nx * nx + ny * ny + nz * nz) || 1;
      areas[k] = nx, areas[k + 1] = ny, areas[k + 2] = nz;
      faces[k] = nx / length, faces[k + 1] = ny / length, faces[k + 2] = nz / length;
      for (let corner = 0; corner < 3; corner++) {
        const from = 3 * triangles[k + corner], to = 3 * (k + corner);
        normals[from] += nx, normals[from + 1] += ny, normals[from + 2] += nz;
        // A triangle with a position that is not known is drawn as a point.
        position[to] = known ? x[from] : 0, position[to + 1] = known ? x[from + 1] : 0, position[to + 2] = known ? x[from + 2] : 0;
      }
    }
    for (let i = 0; i < smooth.length; i++) {
      const nx = normals[3 * i], ny = normals[3 * i + 1], nz = normals[3 * i + 2];
      const least = SMOOTH * Math.sqrt(nx * nx + ny * ny + nz * nz);
      let all = 1;
      for (let k = first[i]; k < first[i + 1] && all; k++) {
        const face = 3 * around[k];
        if (nx * faces[face] + ny * faces[face + 1] + nz * faces[face + 2] < least) all = 0;
      }
      smooth[i] = all;
    }
    for (let k = 0; k < triangles.length; k++) {
      const vertex = triangles[k];
      let nx = normals[3 * vertex], ny = normals[3 * vertex + 1], nz = normals[3 * vertex + 2];
      if (!smooth[vertex]) {
        const own = k - (k % 3);
        nx = ny = nz = 0;
        for (let j = first[vertex]; j < first[vertex + 1]; j++) {
          const face = 3 * around[j];
          const along = faces[face] * faces[own] + faces[face + 1] * faces[own + 1] + faces[face + 2] * faces[own + 2];
          if (along > SHARP) nx += areas[face], ny += areas[face + 1], nz += areas[face + 2];
        }
      }
      const length = Math.sqrt(nx * nx + ny * ny + nz * nz) || 1;
      normal[3 * k] = nx / length, normal[3 * k + 1] = ny / length, normal[3 * k + 2] = nz / length;
    }
    this.geometry.attributes.position.needsUpdate = true;
    this.geometry.attributes.normal.needsUpdate = true;
  }

  /** Colours of a table (256, 3), linear, by codes of triangles or of vertices; null for plain cloth. */
  paint(codes, table) {
    this.object.material = codes ? this.coloured : this.plain;
    if (!codes) return;
    const colour = this.geometry.attributes.color.array;
    const ofTriangles = 3 * codes.length === this.triangles.length;
    for (let k = 0; k < this.triangles.length; k++) {
      const from = 3 * codes[ofTriangles ? (k / 3) | 0 : this.triangles[k]];
      colour[3 * k] = table[from], colour[3 * k + 1] = table[from + 1], colour[3 * k + 2] = table[from + 2];
    }
    this.geometry.attributes.color.needsUpdate = true;
  }
}

/** Balls at vertices. */
class Balls {
  constructor(vertices, radius, colour, geometry = new SphereGeometry(1, 20, 14)) {
    this.vertices = vertices;
    this.radius = radius;
    this.object = new InstancedMesh(geometry, material(colour, [1, 1, 1]), vertices.length);
    this.object.castShadow = this.object.receiveShadow = true;
    this.object.frustumCulled = false;
  }

  move(x) {
    const at = new Matrix4();
    this.vertices.forEach((vertex, k) => {
      const p = x.subarray(3 * vertex, 3 * vertex + 3);
      const r = p.every(Number.isFinite) ? this.radius : 0;
      this.object.setMatrixAt(k, at.makeScale(r, r, r).setPosition(r ? p[0] : 0, r ? p[1] : 0, r ? p[2] : 0));
    });
    this.object.instanceMatrix.needsUpdate = true;
  }
}

/** Tubes between pairs of vertices, with round ends. */
class Tubes {
  constructor(lines, radius, colour) {
    this.lines = lines;
    this.radius = radius;
    this.ends = new Balls([...new Set(lines)], radius, colour, new SphereGeometry(1, 12, 8));
    this.sides = new InstancedMesh(new CylinderGeometry(1, 1, 1, 12, 1, true), material(colour, [1, 1, 1]), lines.length / 2);
    this.sides.castShadow = this.sides.receiveShadow = true;
    this.sides.frustumCulled = false;
    this.object = new Group().add(this.sides, this.ends.object);
  }

  move(x) {
    this.ends.move(x);
    const at = new Matrix4(), turn = new Quaternion(), up = new Vector3(0, 1, 0);
    const a = new Vector3(), b = new Vector3(), along = new Vector3(), size = new Vector3();
    for (let k = 0; k < this.lines.length; k += 2) {
      a.fromArray(x, 3 * this.lines[k]), b.fromArray(x, 3 * this.lines[k + 1]);
      const length = along.subVectors(b, a).length();
      if (length > 0) turn.setFromUnitVectors(up, along.divideScalar(length));
      const known = Number.isFinite(length);
      size.set(this.radius, length, this.radius).multiplyScalar(known ? 1 : 0);
      this.sides.setMatrixAt(k / 2, known ? at.compose(a.add(b).multiplyScalar(0.5), turn, size) : at.makeScale(0, 0, 0));
    }
    this.sides.instanceMatrix.needsUpdate = true;
  }
}

/** One shape of the page. Its positions are drawn relative to an origin, in a unit. */
export class Shape {
  constructor(data, decoded, origin, unit) {
    this.data = data;
    this.codes = decoded.positions;
    this.origin = origin;
    this.unit = unit;
    this.points = new Float32Array(3 * data.count);
    this.object = new Group();
    this.parts = [];
    this.surface = null;
    if (decoded.triangles.length) {
      this.parts.push((this.surface = new Surface(decoded.triangles, data.count, data.colour, data.back)));
    }
    if (decoded.lines.length) this.parts.push(new Tubes(decoded.lines, data.radius / unit, data.colour));
    if (decoded.balls.length) this.parts.push(new Balls(decoded.balls, data.ballRadius / unit, data.ballColour));
    for (const part of this.parts) this.object.add(part.object);
    this.shown = -1;
  }

  /** The position [m] of a vertex on an axis; NaN if it is not known. */
  at(frame, vertex, axis) {
    const { count, low, quantum, moves } = this.data;
    const code = this.codes[((moves ? frame : 0) * 3 + axis) * count + vertex];
    return code === NOWHERE ? NaN : low[axis] + quantum * code;
  }

  show(frame) {
    frame = this.data.moves ? frame : 0;
    if (frame === this.shown) return;
    this.shown = frame;
    const { count, low, quantum } = this.data;
    for (let axis = 0; axis < 3; axis++) {
      const from = (3 * frame + axis) * count;
      const first = (low[axis] - this.origin[axis]) / this.unit;
      const step = quantum / this.unit;
      for (let i = 0; i < count; i++) {
        const code = this.codes[from + i];
        this.points[3 * i + axis] = code === NOWHERE ? NaN : first + step * code;
      }
    }
    for (const part of this.parts) part.move(this.points);
  }
}
