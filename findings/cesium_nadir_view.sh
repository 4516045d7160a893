#!/usr/bin/env bash
# CesiumJS 1.145: camera.setView with a direction and an up vector loses the roll of a camera that looks nearly straight down.
#
# The orientation is turned into heading, pitch and roll. Where the direction is less than 2.56 degrees from the vertical
# (its cosine is within 0.001 of 1), the roll is taken as 0, while the pitch stays as it is. So the camera of a drone that
# looks down is up to 3.6 degrees off, without a warning; at 2.6 degrees it is right again. Setting camera.direction,
# camera.up and camera.right is exact. Issue 6032 of CesiumGS/cesium, open since 2017, describes it.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
npm init -y >/dev/null
npm install --silent --no-audit --no-fund --ignore-scripts cesium@1.145.0 >/dev/null
cat >view.cjs <<'JAVASCRIPT'
const assert = require("node:assert");
const { Camera, Cartesian3, GeographicProjection, Math: M, Matrix4, SceneMode, Transforms } = require("cesium");

const canvas = { clientWidth: 600, clientHeight: 400 };
const camera = new Camera({ mode: SceneMode.SCENE3D, mapProjection: new GeographicProjection(), canvas,
  drawingBufferWidth: 600, drawingBufferHeight: 400 });
const here = Cartesian3.fromDegrees(-92, 46.8, 400);
const frame = Transforms.eastNorthUpToFixedFrame(here);
const vector = (...enu) => Matrix4.multiplyByPointAsVector(frame, new Cartesian3(...enu), new Cartesian3());
const off = {};
for (const degrees of [1, 2.5, 2.6, 5]) {  // leans to the east; north is up in the picture
  const lean = M.toRadians(degrees), up = vector(0, 1, 0), direction = vector(Math.sin(lean), 0, -Math.cos(lean));
  camera.setView({ destination: here, orientation: { direction, up } });
  off[degrees] = M.toDegrees(Cartesian3.angleBetween(camera.directionWC, direction));
  console.log(`${degrees} degrees from straight down: the camera looks ${off[degrees].toFixed(2)} degrees beside the direction given`);
}
assert(off[1] > 1.3 && off[2.5] > 3.4 && off[2.6] < 0.01 && off[5] < 0.01, "the behaviour has changed");
JAVASCRIPT
node view.cjs
