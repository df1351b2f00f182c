// Search from a folder: a browser starts no worker for a page opened as file://, so the search runs in a hidden frame.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    #ready;
    constructor(script) {
      super();
      const frame = document.createElement("iframe");
      frame.hidden = true;
      document.body.append(frame);
      const inside = frame.contentWindow;
      inside.postMessage = (data) => {
        const event = new MessageEvent("message", { data: structuredClone(data) });
        this.dispatchEvent(event);
        this.onmessage?.(event);
      };
      const load = (url) =>
        new Promise((resolve, reject) => {
          const tag = inside.document.createElement("script");
          Object.assign(tag, { src: url, onload: resolve, onerror: reject });
          inside.document.body.append(tag);
        });
      inside.importScripts = async (...urls) => { for (const url of urls) await load(url); };
      this.#ready = load(script);
      this.inside = inside;
    }
    postMessage(data) {
      this.#ready.then(() => this.inside.dispatchEvent(new this.inside.MessageEvent("message", { data })));
    }
    terminate() { this.inside.frameElement.remove(); }
  };
}
