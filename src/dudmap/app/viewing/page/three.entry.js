// The parts of three.js 0.187.0 (MIT, three.LICENSE.txt) that the page uses. Made by esbuild 0.28.2 from the npm packages:
//   npm install three@0.187.0 esbuild@0.28.2
//   npx esbuild three.entry.js --bundle --minify --format=iife --global-name=THREE --outfile=three.min.js
export {
  AmbientLight, BoxGeometry, BufferAttribute, BufferGeometry, Color, DirectionalLight, DoubleSide, EdgesGeometry, FrontSide, Group,
  Line, LineBasicMaterial, LineSegments, Mesh, MeshBasicMaterial, MeshLambertMaterial, PerspectiveCamera, Raycaster, Scene,
  SphereGeometry, Vector2, Vector3, Matrix4, Quaternion, WebGLRenderer, REVISION,
} from "three";
export { OrbitControls } from "three/addons/controls/OrbitControls.js";
