// The element of the page: the view of core.js, and the socket that poses and frames go through.
import { THREE, OrbitControls } from "nicegui-scene";
export default {
  template: `<div style="width:100%;height:100%"></div>`,
  async mounted() {
    const { mount, unpack } = await import("/core.js");
    const scene = unpack(await (await fetch("/scene.bin")).arrayBuffer());
    const socket = new WebSocket(`ws://${location.host}/frames`);
    socket.binaryType = "arraybuffer";
    const send = (m) => socket.readyState === 1 && socket.send(JSON.stringify(m));
    const view = mount(THREE, OrbitControls, this.$el, scene, { onPose: (tool, pose) => send({ tool, pose }) });
    this.view = window.trachea = view;
    socket.onmessage = (m) => {
      view.frame(m.data);
      requestAnimationFrame(() => send("drawn")); // the view has asked for its turn before
    };
    socket.onclose = (e) => this.$emit("lost", e.code);
  },
  methods: {
    place(x, y, z) { this.view?.place(x, y, z); },
    posed(pose) { this.view?.posed(pose); },
  },
};
