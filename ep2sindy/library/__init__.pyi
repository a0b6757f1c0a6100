# Libraries
from ep2sindy.library.equations import equation_text as equation_text
