#!/bin/sh
# Builds ../viewer.js, the code of the pages that `warpcloth view` writes, and copies the licence of three.js beside it.
# It needs node and npm; package-lock.json fixes the versions. The same sources give the same bytes.
set -eu
cd "$(dirname "$0")"
npm ci --ignore-scripts --no-audit --no-fund
sources=$(cat main.js decode.js shapes.js package-lock.json | sha256sum | cut -c 1-64)
npx esbuild main.js --bundle --minify --format=iife --target=es2022 --legal-comments=none --log-level=warning \
  --banner:js="/* warpcloth viewer with three.js, of sources $sources */" --outfile=../viewer.js
cp node_modules/three/LICENSE ../three.LICENSE
