// Tables, formulas and code that scroll can be reached by keyboard; the theme's copy buttons are no landmarks of their own.
const mend = () => {
  for (const wrap of document.querySelectorAll(".md-typeset__scrollwrap, pre > code, .formula")) {
    if (wrap.scrollWidth > wrap.clientWidth) wrap.tabIndex = 0
    else wrap.removeAttribute("tabindex")
  }
  for (const bar of document.querySelectorAll(".md-code__nav")) bar.setAttribute("role", "none")
}
new MutationObserver(mend).observe(document.body, { childList: true, subtree: true })
addEventListener("resize", mend)
mend()
