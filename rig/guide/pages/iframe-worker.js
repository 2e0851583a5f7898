// A page that was opened from a file may start no worker, and the search is one. Here its script
// runs in a hidden frame instead, with the same messages.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      this.queue = [];
      const frame = document.createElement("iframe");
      frame.hidden = true;
      frame.title = "Search";
      document.body.append(frame);
      this.inner = frame.contentWindow;
      this.inner.postMessage = data => this.dispatchEvent(new MessageEvent("message", { data }));
      const script = this.inner.document.createElement("script");
      script.src = url;
      script.addEventListener("load", () => this.begin());
      this.inner.document.body.append(script);
    }

    begin() {
      const waiting = this.queue;
      this.queue = null;
      for (const data of waiting) this.postMessage(data);
    }

    postMessage(data) {
      if (this.queue) this.queue.push(data);
      else this.inner.dispatchEvent(new this.inner.MessageEvent("message", { data }));
    }
  };
}
