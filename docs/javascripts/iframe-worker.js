/*
 * The search of this documentation runs in a web worker, which browsers do not start for pages that
 * are opened from a folder (file:). There this class takes its place: a hidden frame of the same
 * page, in which the worker's script runs. The search looks for the name IFrameWorker.
 */
if (location.protocol === 'file:') {
  window.IFrameWorker = class extends EventTarget {
    constructor(path) {
      super();
      const url = new URL(path, location).href;
      this.onmessage = null;
      const frame = document.createElement('iframe');
      frame.hidden = true;
      document.body.append(frame);
      const inside = frame.contentWindow;
      const load = (each) => new Promise((resolve, reject) => {
        const script = inside.document.createElement('script');
        script.src = new URL(each, url).href;
        script.onload = resolve;
        script.onerror = () => reject(new Error(`cannot load ${script.src}`));
        inside.document.head.append(script);
      });
      inside.importScripts = (...all) =>
        all.reduce((before, each) => before.then(() => load(each)), Promise.resolve());
      inside.postMessage = (data) => {
        const event = new MessageEvent('message', { data });
        this.dispatchEvent(event);
        if (this.onmessage) this.onmessage(event);
      };
      this.inside = inside;
      this.loaded = load(url);
    }

    postMessage(data) {
      this.loaded.then(() => {
        const { MessageEvent: Inside } = this.inside;
        this.inside.dispatchEvent(new Inside('message', { data }));
      });
    }

    terminate() {
      this.inside.frameElement.remove();
    }
  };
  window.Worker = window.IFrameWorker;
}
