"""From a scene to an image: rays, light, blur, speckle, grey values."""
