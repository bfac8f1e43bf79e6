// Reads GLB files with the Khronos glTF validator and prints, per file, what it found: {issues, info}.
// node validate_glb.js <directory of node_modules> FILE ...
const fs = require("fs");
const path = require("path");
const validator = require(path.join(path.resolve(process.argv[2]), "gltf-validator"));

(async () => {
  const reports = [];
  for (const file of process.argv.slice(3)) {
    const report = await validator.validateBytes(new Uint8Array(fs.readFileSync(file)), { maxIssues: 0 });
    reports.push({ issues: report.issues, info: report.info });
  }
  console.log(JSON.stringify(reports));
})();
